"""Suspends a run at its checkpoints while a sensor is not well, and lets it go on, or ends it after a limit."""

from __future__ import annotations

from drivers.errors import DeviceFault
from drivers.health import Ailment, StationHealth
from drivers.interfaces import Arm
from drivers.station import Devices
from experiments.context import RunContext

#: how often a suspended run looks again [s]
LOOK = 0.25
#: a trial that a device cuts off this often is not run again
TRIES = 3


class Suspender:
    """Looks at the sensors of an open station, at checkpoints and nowhere else: a trial is never paused in contact."""

    def __init__(self, context: RunContext, devices: Devices):
        self._context, self._devices = context, devices
        self._how = context.resolved.experiment.health
        self._health = StationHealth(devices)
        self._told: set[str] = set()

    def checkpoint(self) -> None:
        """Return once every sensor is well, or at once where a warning is enough.

        Raises DeviceFault, named after the first that is not well, after the limit.
        """
        found = self._health.ailments()
        if not found:
            self._told.clear()
            return
        said = "; ".join(map(str, found))
        if self._how.on_fault == "warn":
            if said not in self._told:
                self._context.event("warning", f"not well: {said}")
                self._told.add(said)
            return
        self._context.event("warning", f"paused, for {self._how.limit:g} s at most: {said}")
        waited, left = self._wait()
        if left:
            remedy = f"See to it, then go on: `extrinsic run --resume {self._context.folder.path}`"
            raise DeviceFault(
                left[0].device, "be well at a checkpoint", f"{left[0].text}, {waited:.3g} s later", remedy
            )
        self._context.event("info", f"goes on after {waited:.3g} s")

    def has_come_back(self, device: str) -> bool:
        """Whether the ``device`` that cut a trial off is well, as all others are, at once or within the limit.

        An arm is not waited for: it was let go where it was, and a person looks before it moves. Nor is what is no
        device of the station, such as the disk.
        """
        sensors = {known.name for known in self._devices.values() if not isinstance(known, Arm)}
        if self._how.on_fault != "pause" or not sensors.issuperset(device.split(", ")):
            return False
        waited, left = self._wait()
        if not left:
            when = f"the devices are well again after {waited:.3g} s" if waited else f"{device} is well again"
            self._context.event("info", f"{when}: the trial is run again")
        return not left

    def _wait(self) -> tuple[float, list[Ailment]]:
        """Let time pass until all is well or the limit is reached; how long it was [s], and what is still not well."""
        begin_ns, waited, found = self._devices.clock.now_ns(), 0.0, self._health.ailments()
        while found and waited < self._how.limit:
            if not all(self._health.reopen(ailment.device, LOOK) for ailment in found if ailment.kind == "gone"):
                break
            self._devices.clock.sleep(LOOK)
            waited = (self._devices.clock.now_ns() - begin_ns) * 1e-9  # opening a device again takes its time, too
            self._context.heed()
            found = self._health.ailments()
        return waited, found
