"""What a skill is, what it is given, what it gives back, and the register of them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, TypeVar

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, PositiveFloat

from mechanics.polygon import Polygon
from mechanics.readings import Array
from planning.problem import Body, Form, Limits, LossWeights, Problem


class SkillParameters(BaseModel):
    """What the user of a skill may choose: frozen, unknown keys rejected."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


@dataclass(frozen=True, eq=False)
class Held:
    """The grasped object in the fingers, and its friction on the ground.

    ``vertices`` (V, 2) [m] in the go's frame, whose origin is its centre of mass; ``mass`` [kg]; ``grasp`` (3,)
    X_go_gocf; ``stiffness`` (3, 3) [N/m, N, N·m/rad] in gocf; ``mu`` of go on ground; ``gravity`` [m/s²]; ``rho`` [m]
    the radius of gyration, by default that of the outline. Raises ValueError naming the field that does not fit.
    """

    vertices: Array
    mass: float
    grasp: Array
    stiffness: Array
    mu: float
    gravity: float = 9.81
    rho: float | None = None

    def __post_init__(self) -> None:
        for name in ("vertices", "grasp", "stiffness"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64))
        _check_outline(self.vertices)
        if self.rho is None:
            object.__setattr__(self, "rho", Polygon(self.vertices).radius_of_gyration)

    @property
    def body(self) -> Body:
        """What a problem knows of it."""
        assert self.rho is not None  # __post_init__
        return Body(self.vertices, self.mass, self.rho)


@dataclass(frozen=True, eq=False)
class Extrinsic:
    """The object on the table: ``vertices`` (V, 2) [m] about its centre of mass, counter-clockwise; ``mass`` [kg].

    ``mu_object`` of go on eo, ``mu_ground`` of eo on ground; ``rho`` [m] as in `Held`. Raises ValueError naming the
    field that does not fit.
    """

    vertices: Array
    mass: float
    mu_object: float
    mu_ground: float
    rho: float | None = None

    def __post_init__(self) -> None:
        vertices = np.asarray(self.vertices, dtype=np.float64)
        _check_outline(vertices)
        outline = Polygon(vertices)
        object.__setattr__(self, "vertices", outline.vertices)
        if self.rho is None:
            object.__setattr__(self, "rho", outline.radius_of_gyration)
        for name in ("mu_object", "mu_ground"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name}: expected a number ≥ 0, received {getattr(self, name)}")

    @property
    def body(self) -> Body:
        """What a problem knows of it."""
        assert self.rho is not None  # __post_init__
        return Body(self.vertices, self.mass, self.rho)


@dataclass(frozen=True, eq=False)
class Scene:
    """What a skill acts on: the grasped object and, for those that need one, the extrinsic one."""

    held: Held
    extrinsic: Extrinsic | None = None


@dataclass(frozen=True, eq=False)
class SkillTask:
    """What a planner is asked for.

    ``problem`` is the trajectory; ``rest`` (one step) is how things lie while the force is ramped up before step 0,
    None where they lie as in step 0. ``back``: after the last step the trajectory is played back to the rest before
    the force is ramped down, for a pivoted object must not be let fall. ``supported``: something else has to hold the
    extrinsic object while the force is ramped, since without the go's push it does not stay where it begins.
    ``disturbance`` [N]: the plan has to bear this much more and less force of the go, along the unit directions
    ``push`` (K, 2) in W, on the body acted on.
    """

    problem: Problem
    disturbance: float
    push: Array
    rest: Problem | None = None
    back: bool = False
    supported: bool = False

    @property
    def steps(self) -> int:
        """K."""
        return self.problem.steps


class Skill(ABC):
    """A way to move objects in contact; it turns parameters and a scene's figures into a task."""

    name: ClassVar[str]
    Parameters: ClassVar[type[SkillParameters]]
    #: whether the scene needs an extrinsic object
    needs_extrinsic: ClassVar[bool] = False

    @staticmethod
    @abstractmethod
    def task(
        parameters: Any,
        scene: Scene,
        form: Form = Form.CLOSED,
        weights: LossWeights = LossWeights(),
        limits: Limits = Limits(),
    ) -> SkillTask:
        """Return the task.

        Raises ValueError naming the parameter that the geometry does not allow, and InfeasiblePlan where no admissible
        force does what the parameters ask for.
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

Angle = Annotated[float, Field(ge=-180, le=180)]
"""[deg]"""

Steps = Annotated[int, Field(ge=1, le=10_000)]
"""How many waypoints."""

Disturbance = Annotated[float, Field(ge=0, le=100)]
"""[N] that the contacts have to bear on top of, and short of, what is planned."""


def ramp(ends: tuple[float, float], steps: int) -> Array:
    """Return ``steps`` values (steps,) from the first to the last; a single step takes the first."""
    return np.linspace(*ends, steps)


def _check_outline(vertices: Array) -> None:
    shape = vertices.shape
    if len(shape) != 2 or shape[1] != 2 or shape[0] < 3 or not np.isfinite(vertices).all():
        raise ValueError(f"vertices: expected three or more finite (x, y), received shape {shape}")
