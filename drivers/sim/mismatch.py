"""How far the simulated world is from what the planner believes of it: the mismatch profiles, `profiles/*.yaml`.

A profile is a set of figures. What is constant in a lab (stiffness, friction, the arm's bias, a sensor's gain) is drawn
once per seed; what no calibration removes (how the object lies in the fingers, the arm's repeatability, the walk of a
sensor's zero) is drawn afresh per trial, from the seed and the trial's number alone, so that every controller meets the
same eight grasps and errors.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from math import radians
from pathlib import Path
from zlib import crc32

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from drivers.scene import Strict, Vector2
from drivers.sim.bubble_noise import BubbleNoise
from drivers.sim.gel_noise import GelNoise
from drivers.sim.membrane import Membrane
from mechanics.readings import Array
from mechanics.yaml_input import InputError, Problem, locate, nearest, one_of, parse, read_yaml

Pose = tuple[float, float, float]
Vector5 = tuple[float, float, float, float, float]
Vector6 = tuple[float, float, float, float, float, float]

FOLDER = Path(str(files("drivers.sim") / "profiles"))
_OCTANTS = 8
_NOTHING: Vector6 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class Planar(Strict):
    """An error of a planar pose: its size along x and y, and about the plane's normal."""

    xy_mm: Vector2 = (0.0, 0.0)
    angle_deg: float = 0.0

    @property
    def si(self) -> Array:
        """(3,) = (x, y, θ) [m, m, rad]."""
        return np.array([self.xy_mm[0] * 1e-3, self.xy_mm[1] * 1e-3, radians(self.angle_deg)])


class Stream(Strict):
    """What happens to readings between the sensor and whoever receives them."""

    latency: float = Field(default=0.0, ge=0, le=1, description="age of a reading when it arrives [s]")
    dropout: float = Field(default=0.0, ge=0, lt=1, description="share of the readings that never arrive")


class StiffnessFigures(Strict):
    """The true K against the one the planner has."""

    error: float = Field(default=0.0, ge=0, lt=0.3, description="relative, 1 sigma, of each entry of K")


class FingerFigures(Strict):
    """What a pair of fingers can hold; nothing: without limit."""

    force_limit: float | None = Field(default=None, gt=0, description="force at which the object slips in them [N]")
    torque_limit: float | None = Field(default=None, gt=0, description="torque at which it turns in them [N·m]")


class FrictionFigures(Strict):
    """The true coefficients against those of the scene."""

    error: float = Field(default=0.0, ge=0, lt=0.3, description="relative, 1 sigma, of each pair's coefficient")


class ArmFigures(Stream):
    """The true pose of the ee against the reported one, which follows the set-points with a lag."""

    bias: Planar = Field(default=Planar(), description="1 sigma, constant, in W")
    repeatability: Planar = Field(default=Planar(), description="1 sigma, anew in each motion, in W")
    lag: float = Field(default=0.0, ge=0, le=0.2, description="time constant of the drives [s]")


class GraspFigures(Strict):
    """How the object lies in the fingers against how the planner believes it does, anew in each trial."""

    offset: Planar = Field(default=Planar(), description="in gocf; signs by the octants of eight trials")
    spread: float = Field(default=0.0, ge=0, lt=1, description="relative half-width about `offset`, uniform")


class ForceTorqueFigures(Stream):
    """A six-axis sensor. Six figures in a row are for fx, fy, fz [N], tx, ty, tz [N·m]; forces and torques for both."""

    noise: Vector6 = Field(default=_NOTHING, description="1 sigma of a reading")
    resolution: Vector6 = Field(default=_NOTHING, description="step of the digits; 0: none")
    bias_force: float = Field(default=0.0, ge=0, description="1 sigma, constant [N]")
    bias_torque: float = Field(default=0.0, ge=0, description="1 sigma, constant [N·m]")
    drift_force: float = Field(default=0.0, ge=0, description="1 sigma of the walk after 30 s [N]")
    drift_torque: float = Field(default=0.0, ge=0, description="1 sigma of the walk after 30 s [N·m]")
    gain_error: float = Field(default=0.0, ge=0, lt=0.3, description="relative, 1 sigma, of each axis")
    temperature_walk: float = Field(default=0.0, ge=0, description="1 sigma of the sensor's warming after 60 s [K]")
    temperature_force: float = Field(default=0.0, ge=0, description="1 sigma of the zero's shift [N/K]")
    temperature_torque: float = Field(default=0.0, ge=0, description="1 sigma of the zero's shift [N·m/K]")
    temperature_gain: float = Field(default=0.0, ge=0, description="1 sigma of the gain's relative shift [1/K]")
    tool_mass: float = Field(default=0.0, ge=0, description="of gripper and fingers, on the wrist sensor [kg]")
    tool_centre_mm: Vector2 = Field(default=(0.0, 0.0), description="the tool's centre of mass in ee")
    tool_error: float = Field(default=0.0, ge=0, lt=0.3, description="of the mass that is known, relative, 1 sigma")


class CameraFigures(Stream):
    """The tag camera and the tags. All of it passes through the pixels."""

    noise: float = Field(default=0.0, ge=0, description="1 sigma of a pixel [grey levels]")
    blur_px: float = Field(default=0.0, ge=0, le=10, description="1 sigma of lens and focus")
    distortion: Vector5 = Field(
        default=(0.0, 0.0, 0.0, 0.0, 0.0), description="k1, k2, p1, p2, k3 of the lens, as calibrated"
    )
    distortion_error: float = Field(default=0.0, ge=0, lt=1, description="what calibration leaves, relative, 1 sigma")
    focal_error: float = Field(default=0.0, ge=0, lt=0.1, description="what calibration leaves, relative, 1 sigma")
    exposure: float = Field(default=0.0, ge=0, lt=1, description="relative brightness of a frame, 1 sigma")
    exposure_time: float = Field(default=0.0, ge=0, le=0.1, description="of a frame; what moves is smeared [s]")
    tag_bias: Planar = Field(default=Planar(), description="how a tag sits on its body, 1 sigma, constant")


class Mismatch(Strict):
    """A profile. Every figure is zero unless the file says otherwise, so that `ideal` is the empty profile.

    A new kind of mismatch is a figure here and a line in the device or the plant that it disturbs.
    """

    description: str = ""
    stiffness: StiffnessFigures = StiffnessFigures()
    membrane: Membrane = Membrane()
    fingers: FingerFigures = FingerFigures()
    friction: FrictionFigures = FrictionFigures()
    arm: ArmFigures = ArmFigures()
    grasp: GraspFigures = GraspFigures()
    gripper: Stream = Stream()
    force_torque: ForceTorqueFigures = ForceTorqueFigures()
    camera: CameraFigures = CameraFigures()
    gel: GelNoise = GelNoise()
    bubble: BubbleNoise = BubbleNoise()


# -- files -----------------------------------------------------------------------------------------------------------


def profile_names() -> list[str]:
    """The shipped profiles."""
    return sorted(path.stem for path in FOLDER.glob("*.yaml"))


def load_profile(name: str) -> Mismatch:
    """The shipped profile ``name``, or the one in the file ``name`` where that is a path (``./mine.yaml``).

    Raises InputError with file, line, what was expected and the nearest name.
    """
    if name in profile_names():
        return parse(Mismatch, read_yaml(FOLDER / f"{name}.yaml", root=FOLDER.parent))
    if Path(name).name != name or name.endswith((".yaml", ".yml")):
        return parse(Mismatch, read_yaml(locate(name, "world profile", [], [FOLDER])))
    names = profile_names()
    raise InputError(
        [
            Problem(
                "world.profile", None, "", f"no profile '{name}'", f"{one_of(names)}, or a path", nearest(name, names)
            )
        ]
    )


# -- draws -----------------------------------------------------------------------------------------------------------


def stream(seed: int, *what: str | int) -> np.random.Generator:
    """Random numbers for one purpose: a new purpose leaves the numbers of the others as they were."""
    return np.random.default_rng([seed, *(crc32(w.encode()) if isinstance(w, str) else w for w in what)])


@dataclass(frozen=True)
class Lab:
    """One lab out of all that a profile describes: what stays as it is for a whole run of ``seed``."""

    profile: Mismatch
    seed: int

    @property
    def arm_bias(self) -> Pose:
        """True pose of the ee less the reported one, (x, y, θ) in W."""
        x, y, theta = (self.profile.arm.bias.si * stream(self.seed, "arm.bias").standard_normal(3)).tolist()
        return x, y, theta

    def stiffness(self, nominal: ArrayLike) -> Array:
        """The true K (3, 3): each entry off by the profile's share, symmetric and positive definite."""
        nominal = np.array(nominal, float)
        sigma = self.profile.stiffness.error
        if sigma == 0:
            return nominal
        rng = stream(self.seed, "stiffness")
        while True:
            factors = np.triu(1 + sigma * rng.standard_normal((3, 3)))
            K = nominal * (factors + np.triu(factors, 1).T)
            if np.linalg.eigvalsh(K)[0] > 0.1 * np.linalg.eigvalsh(nominal)[0]:
                return K

    def friction(self, nominal: dict[str, float]) -> dict[str, float]:
        """The true coefficient of each pair."""
        sigma = self.profile.friction.error
        if sigma == 0:
            return nominal
        off = {pair: stream(self.seed, "friction", pair).standard_normal() for pair in nominal}
        return {pair: mu * max(0.1, 1 + sigma * float(off[pair])) for pair, mu in nominal.items()}

    def tag_bias(self, id: int) -> Array:
        """Where tag ``id`` truly sits less where it is believed to, (3,) in its own frame."""
        size = self.profile.camera.tag_bias.si
        return size * stream(self.seed, "tag", id).standard_normal(3) if size.any() else size

    def grasp_offset(self, trial: int) -> Array:
        """Where gocf truly is less where the planner has it, (3,) in gocf, in trial ``trial`` from 0.

        Sizes are the profile's, each within its spread. Eight trials in a row go through the eight sign octants, in
        an order of the seed's: the error of an open-loop trial hangs on the octant more than on the sizes.
        """
        figures = self.profile.grasp
        octant = int(stream(self.seed, "grasp.octants").permutation(_OCTANTS)[trial % _OCTANTS])
        signs = np.array([1.0 if octant >> axis & 1 else -1.0 for axis in range(3)])
        return figures.offset.si * signs * (1 + figures.spread * stream(self.seed, "grasp", trial).uniform(-1, 1, 3))

    def membrane_strain(self, trial: int) -> Array:
        """What the handling before trial ``trial`` leaves in the membrane: (3,), uniform in the unit ball.

        See `drivers.sim.membrane.MembraneSpring.strain`.
        """
        if self.profile.membrane.hysteresis == 0:
            return np.zeros(3)
        rng = stream(self.seed, "membrane", trial)
        direction = rng.standard_normal(3)
        return direction / np.linalg.norm(direction) * np.cbrt(rng.uniform())
