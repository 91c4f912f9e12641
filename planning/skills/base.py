"""What a skill is, and the register of them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, TypeVar

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, PositiveFloat

from mechanics.readings import Array
from planning.task import ContactRequest, Task


class SkillParameters(BaseModel):
    """What the user of a skill may choose: frozen, unknown keys rejected."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


@dataclass(frozen=True, eq=False)
class Held:
    """The grasped object in the fingers, and what it stands on.

    ``vertices`` (V, 2) [m] in the go's frame, whose origin is its centre of mass; ``mass`` [kg]; ``grasp`` (3,)
    X_go_gocf; ``stiffness`` (3, 3) [N/m, N, N·m/rad] in gocf; ``mu`` of go on ground; ``gravity`` [m/s²]. Raises
    ValueError naming the field that does not fit.
    """

    vertices: Array
    mass: float
    grasp: Array
    stiffness: Array
    mu: float
    gravity: float = 9.81

    def __post_init__(self) -> None:
        for name in ("vertices", "grasp", "stiffness"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64))
        shape = self.vertices.shape
        if len(shape) != 2 or shape[1] != 2 or shape[0] < 3 or not np.isfinite(self.vertices).all():
            raise ValueError(f"vertices: expected three or more finite (x, y), received shape {shape}")

    def task(self, skill: str, go: Array, contacts: tuple[ContactRequest, ...]) -> Task:
        """The task of a skill that moves this object along ``go`` (K, 3) in ``contacts``."""
        return Task(skill, go, contacts, self.grasp, self.mass, self.stiffness, gravity=self.gravity)


class Skill(ABC):
    """A way to move the grasped object in contact; it turns parameters and a scene's figures into a task."""

    name: ClassVar[str]
    Parameters: ClassVar[type[SkillParameters]]

    @staticmethod
    @abstractmethod
    def task(parameters: Any, held: Held) -> Task:
        """Return the task. Raises ValueError naming the parameter that the geometry does not allow."""


SKILLS: dict[str, type[Skill]] = {}
"""Every skill by name. `planning.skills` imports each skill's file, which registers it here."""

S = TypeVar("S", bound=type[Skill])


def register(skill: S) -> S:
    """Class decorator: enter a skill under its name."""
    if skill.name in SKILLS:
        raise ValueError(f"skill '{skill.name}' is registered twice: {SKILLS[skill.name]} and {skill}")
    SKILLS[skill.name] = skill
    return skill


def _as_pair(value: object) -> object:
    """Let a single number stand for one that does not change."""
    return (value, value) if isinstance(value, int | float) and not isinstance(value, bool) else value


Ramp = Annotated[tuple[float, float], BeforeValidator(_as_pair, json_schema_input_type=float | tuple[float, float])]
"""First and last value; a single number holds throughout."""

PositiveRamp = Annotated[
    tuple[PositiveFloat, PositiveFloat],
    BeforeValidator(_as_pair, json_schema_input_type=PositiveFloat | tuple[PositiveFloat, PositiveFloat]),
]
"""First and last value, both positive."""


def ramp(ends: tuple[float, float], steps: int) -> Array:
    """Return ``steps`` values (steps,) from the first to the last; a single step takes the first."""
    return np.linspace(*ends, steps)
