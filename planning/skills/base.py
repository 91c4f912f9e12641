"""What a skill is, and the register of them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, TypeVar

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, PositiveFloat

from mechanics.readings import Array
from planning.task import Task


class SkillParameters(BaseModel):
    """What the user of a skill may choose: frozen, unknown keys rejected."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Skill(ABC):
    """A way to move the grasped object in contact; it turns parameters and a scene's figures into a task."""

    name: ClassVar[str]
    Parameters: ClassVar[type[SkillParameters]]

    @staticmethod
    @abstractmethod
    def task(
        parameters: Any,
        *,
        polygon_vertices: Sequence[Sequence[float]] | Array,
        mass: float,
        grasp: Sequence[float] | Array,
        stiffness: Sequence[Sequence[float]] | Array,
        mu: float,
        gravity: float = 9.81,
    ) -> Task:
        """Return the task.

        ``polygon_vertices`` (V, 2) [m] in the go's frame, whose origin is its centre of mass; ``mass`` [kg];
        ``grasp`` (3,) X_go_gocf; ``stiffness`` (3, 3) [N/m, N, N·m/rad] in gocf; ``mu`` go on ground; ``gravity``
        [m/s²]. Raises ValueError naming the parameter that the geometry does not allow.
        """


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
