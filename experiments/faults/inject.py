"""Lets the faults of an ``execute`` stage happen, each at its moment of the trial."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from drivers.interfaces import Simulation
from experiments.faults.schema import Moment, TimedFault

#: how an event begins that tells of a fault that was let happen
INJECTED = "injected: "


class Injector:
    """The faults of one trial, whose trajectory has ``steps`` waypoints; ``tell`` is told of each as it happens.

    Its methods raise what the station raises when it is asked for a fault: DeviceFault where it has died.
    """

    def __init__(
        self, faults: Sequence[TimedFault], simulation: Simulation | None, steps: int, tell: Callable[[str], None]
    ):
        self._waiting = list(faults) if simulation is not None else []
        self._simulation, self._middle, self._tell = simulation, max(0, steps // 2 - 1), tell

    def begin(self) -> None:
        """Before anything of the trial."""
        self._now("before")

    def phase(self, name: str) -> None:
        """The trial enters a phase."""
        moments: dict[str, Moment] = {"approach": "approach", "done": "logging"}
        if name in moments:
            self._now(moments[name])

    def waypoint(self, step: int) -> None:
        """The trial has settled at a waypoint."""
        if step == self._middle:
            self._now("contact")

    def _now(self, moment: Moment) -> None:
        due = [fault for fault in self._waiting if fault.moment == moment]
        self._waiting = [fault for fault in self._waiting if fault.moment != moment]
        for fault in due:
            value = "" if fault.value is None else f" ({fault.value:g})"
            self._tell(f"{INJECTED}{fault.kind}{value} of {fault.device}, {moment}")
            assert self._simulation is not None  # else nothing waits
            self._simulation.inject(fault.model_dump(exclude={"moment"}))
