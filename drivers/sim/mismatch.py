"""How far the simulated world is from what the planner believes of it: the mismatch profiles, `profiles/*.yaml`."""

from __future__ import annotations

from importlib.resources import files

from pydantic import Field, ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from drivers.scene import Strict, Vector3


class Mismatch(Strict):
    """A profile. Every figure is zero unless the file says otherwise, so that `ideal` is the empty profile.

    A new kind of mismatch is a figure here and a line in the device or the plant that it disturbs.
    """

    description: str = ""
    arm_bias: Vector3 = Field(
        default=(0.0, 0.0, 0.0), description="true pose of the ee less the reported one, in W [m, rad]"
    )
    force_noise: float = Field(default=0.0, ge=0, description="standard deviation of a force axis [N]")
    torque_noise: float = Field(default=0.0, ge=0, description="standard deviation of a torque axis [N·m]")


def profile_names() -> list[str]:
    """The shipped profiles."""
    folder = files("drivers.sim") / "profiles"
    return sorted(p.name.removesuffix(".yaml") for p in folder.iterdir() if p.name.endswith(".yaml"))


def load_profile(name: str) -> Mismatch:
    """The profile ``name``. Raises ValueError naming the file, or the profiles there are."""
    if name not in profile_names():
        raise ValueError(f"world.profile: no profile '{name}'; there are {', '.join(profile_names()) or 'none'}")
    path = files("drivers.sim") / "profiles" / f"{name}.yaml"
    try:
        return Mismatch.model_validate(YAML(typ="safe", pure=True).load(path.read_text(encoding="utf-8")) or {})
    except (YAMLError, ValidationError) as error:
        raise ValueError(f"profiles/{name}.yaml: {error}") from None
