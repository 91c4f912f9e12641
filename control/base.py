"""What every controller is: a law that turns measurements into a correction of the planned end-effector poses.

The correction ``c`` (3,) = (x, y, θ) [m, m, rad] lives in gocf, like the elasticity's displacement: the commanded
pose at waypoint k is go_k ⊕ X_go_gocf ⊕ (K⁻¹ w_k + c).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict

from control.monitor import Deviation
from mechanics import se2
from mechanics.readings import Array
from mechanics.records import PlanarState
from planning.plan import Plan


class LawSettings(BaseModel):
    """The figures of a control law, as an experiment file gives them; SI unless the name says otherwise."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Controller(ABC):
    """A control law. One instance runs one trial; ``settings`` are those of its `Settings`, the defaults if None."""

    name: ClassVar[str]
    #: whether the law acts on measurements: it then gets a free-air phase and a correction at every waypoint
    feedback: ClassVar[bool] = True
    #: whether the law takes, as ``task``, what its plan was made of (`planning.skills.base.SkillTask`)
    needs_task: ClassVar[bool] = False
    #: the model of its figures
    Settings: ClassVar[type[LawSettings]] = LawSettings

    def __init__(self, plan: Plan, settings: LawSettings | None = None):
        self.plan = plan
        self.settings = self.Settings() if settings is None else settings
        self.correction = np.zeros(3)

    @abstractmethod
    def in_air(self, go_desired: Array, measured: PlanarState) -> None:
        """Update the correction before touch-down, where only the pose can be wrong."""

    @abstractmethod
    def in_contact(self, step: int, measured: PlanarState) -> None:
        """Update the correction at settled waypoint ``step``, where the plan has ``go[step]`` and ``wrench[step]``."""

    def replan(self, step: int, measured: PlanarState, deviation: Deviation) -> bool:
        """Asked at waypoint ``step``, before ``deviation`` counts: whether the law has taken it in and can go on."""
        return False

    def told(self) -> dict[str, Any] | None:
        """What a trial's row says of the law, as JSON can hold it; None: nothing."""
        return None

    def command(self, go: Array, ee: Array) -> Array:
        """The pose (3,) to command where the plan has the go at ``go`` and the end-effector at ``ee``."""
        X_W_gocf = se2.compose(go, self.plan.X_go_gocf)
        return se2.compose(X_W_gocf, se2.between(X_W_gocf, ee) + self.correction)

    def waypoint(self, step: int) -> Array:
        """The pose (3,) to command at waypoint ``step``."""
        return self.command(self.plan.go[step], self.plan.ee[step])


CONTROLLERS: dict[str, type[Controller]] = {}

C = TypeVar("C", bound=type[Controller])


def register(controller: C) -> C:
    """Class decorator: enter a controller of this package under its name."""
    if controller.name in CONTROLLERS:
        raise ValueError(
            f"controller '{controller.name}' is registered twice: {CONTROLLERS[controller.name]}, {controller}"
        )
    CONTROLLERS[controller.name] = controller
    return controller
