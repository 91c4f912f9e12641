"""The paper's open-loop controller: execute the planned end-effector poses as they are."""

from __future__ import annotations

from control.base import Controller, register
from mechanics.readings import Array
from mechanics.records import PlanarState


@register
class OpenLoop(Controller):
    """Executes the plan; anchored to the table only, blind to the grasp and to the wrench."""

    name = "open_loop"
    feedback = False

    def in_air(self, go_desired: Array, measured: PlanarState) -> None:
        """Does nothing."""

    def in_contact(self, step: int, measured: PlanarState) -> None:
        """Does nothing."""
