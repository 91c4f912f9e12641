"""What a run carries from stage to stage: its files, its plans, its results, and the station once it is needed."""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

from control.observe import Finger
from control.settings import TrialSettings
from drivers.errors import DriverError
from drivers.health import StationHealth
from drivers.hosting import HostProcess
from drivers.scene import Scene
from drivers.station import Devices, Hosting, Station
from drivers.wire.log import LogWriter
from experiments import disk, looks, setup
from experiments.calibrate import store
from experiments.calibrate.models import Calibration
from experiments.calibrate.store import Calibrations
from experiments.files import Resolved
from experiments.progress import Progress
from experiments.run_folder import RunFolder, write_json
from mechanics.records import EventRecord, LookRecord, PhaseRecord, TrialRecord, WaypointRecord
from planning.plan import Plan
from planning.skills.base import SkillTask

#: no stream's readings should be older when they arrive, nor be of the future by more [s]
LATENCY, CLOCKS = 0.1, 0.005
#: the streams have spoken before the first stage needs them [s]
WARM_UP = 0.2
#: figures of the plant's health that count up; of the others the worst counts
_SUMS = ("seconds", "resting_seconds", "contact_changes")

Record = EventRecord | LookRecord | PhaseRecord | TrialRecord | WaypointRecord


class RunContext:
    """One run. ``closing`` holds what has to be closed in order, however it ends; ``host`` as `runner.run` has it.

    What is finished stands in ``results``, under ``progress``: ``stage``, the number of finished stages; ``trials``,
    the number of rows that there were when the stage under way began; ``t_ns``, the station's time when the last stage
    or trial had ended. A run that is resumed begins there.
    """

    def __init__(
        self,
        resolved: Resolved,
        calibrations: Calibrations,
        folder: RunFolder,
        results: dict[str, Any],
        log: LogWriter,
        progress: Progress,
        closing: ExitStack,
        ask: Callable[[str], bool],
        check_interrupt: Callable[[], None],
        host: Hosting = HostProcess,
    ):
        self.resolved = resolved
        self.folder, self.results, self.log, self.progress = folder, results, log, progress
        self.settings: TrialSettings = resolved.experiment.trial
        self.plans: dict[str, Plan] = {}
        #: what the plans of this run's plan stages were made of
        self.tasks: dict[str, SkillTask] = {}
        self.calibrations = calibrations
        self.holder = f"run-{socket.gethostname()}-{os.getpid()}"
        self.ask = ask
        self._check_interrupt = check_interrupt
        self._closing, self._host = closing, host
        self._devices: Devices | None = None
        self._fingers: tuple[Finger, ...] | None = None
        self._begin_ns: int = results["progress"]["t_ns"]
        self._health_untold = False

    def devices(self) -> Devices:
        """The station's devices, opened and logged at the first call; a simulated world is reset to the scene."""
        if self._devices is None:
            with self.progress.step("open the station"):
                devices = self._closing.enter_context(Station(self.resolved.station).connect(self._host))
                devices.attach(self.log)
                if devices.simulation is not None:
                    world = self.resolved.station.world
                    devices.simulation.reset(
                        self.resolved.experiment.seed,
                        setup.scene(self.resolved).model_dump(),
                        None if world is None else world.model_dump(),
                        max(0, self._begin_ns - round(WARM_UP * 1e9)),
                    )
                    devices.tell_descriptions(self.log)  # that of this laboratory's tool among them
                devices.clock.sleep(WARM_UP)
            self._devices = devices
            self._look_at_clocks(devices)
        return self._devices

    def begin(self, scene: Scene, *, part: int = 0, trial: int | None = None, held: str | None = None) -> None:
        """Begin a trial or a calibration: the simulated world is as after a reset, with ``scene``, and time goes on.

        Nothing of what ran before has a say in what comes, so a run that was cut off can go on here. With ``trial`` the
        go is taken into the fingers as that trial has it; ``part`` is the number of what is no trial. The body ``held``
        is held where it is, as by a person's hand, before any time passes. On a real station things are as they are.
        """
        devices = self.devices()
        self._fingers = None  # they remember what pressed them
        if devices.simulation is None:
            return
        self.note_health()
        self._health_untold = True
        devices.simulation.restage(scene.model_dump(), part)
        if trial is not None:
            devices.simulation.regrasp(trial)
        if held is not None:
            devices.simulation.clamp(held)
        devices.clock.sleep(WARM_UP)

    def note_health(self) -> None:
        """How well the simulated plant was since `begin`, into the results; what was not well is an event, too."""
        devices = self._devices
        if not self._health_untold or devices is None or devices.simulation is None:
            return
        self._health_untold = False
        try:
            found = devices.simulation.health()
        except DriverError:  # it has died, and the run's own error says so
            return
        for flag in found["flags"]:
            self.event("warning", f"the simulated plant: {flag}")
        before = self.results.get("health")
        if before is not None:
            for name, value in before.items():
                if name == "flags":
                    found[name] = list(dict.fromkeys([*value, *found[name]]))
                else:
                    found[name] = found[name] + value if name in _SUMS else max(found[name], value)
        self.results["health"] = found

    def _look_at_clocks(self, devices: Devices) -> None:
        """Age and rate of every stream go into the results; a clock that disagrees with ours is a warning."""
        streams = StationHealth(devices).streams()
        self.results["streams"] = streams
        for name, found in streams.items():
            age = found["age_s"]
            if age is not None and not -CLOCKS <= age <= LATENCY:
                said = f"{age:.3g} s old when they arrive" if age > 0 else f"of {-age:.3g} s in the future"
                self.event("warning", f"{name}: its readings are {said}: see that its clock agrees with this machine's")

    def fingers(self) -> tuple[Finger, ...]:
        """The tactile fingers, where controllers are to feel; they are made ready at the first call."""
        if setup.go_pose(self.resolved, self.calibrations) != "tactile":
            return ()
        if self._fingers is None:
            from experiments.fingers import fingers

            self._fingers = fingers(self.resolved, self.devices())
            looks.write(self, "", "fingers")
        return self._fingers

    @property
    def believed(self) -> setup.Believed:
        """What this run takes for true, by what has been calibrated until now."""
        return setup.believed(self.resolved, self.calibrations)

    def calibrated(self, calibration: Calibration) -> None:
        """Keep what a stage has found: for the later stages, in the run folder, and for later runs on this station.

        results.json has it once the stage has ended: one that was cut off is repeated with what was known before it.
        """
        store.save(self.folder.calibration, calibration)
        file = store.save(store.folder_of(self.resolved), calibration)
        self.calibrations.add(calibration, file)

    @contextmanager
    def timed(self, devices: Devices) -> Iterator[None]:
        """Add wall time and station time of the block to the results, whatever ends it.

        What a run took that was cut off and mended without its results is not known, nor is then the whole.
        """
        wall, station_ns = time.perf_counter(), devices.clock.now_ns()
        try:
            yield
        finally:
            timing = self.results["timing"]
            if timing["execute_wall_s"] is not None:
                timing["execute_wall_s"] += time.perf_counter() - wall
            if timing["execute_station_s"] is not None:
                timing["execute_station_s"] += (devices.clock.now_ns() - station_ns) * 1e-9

    @property
    def opened(self) -> Devices | None:
        """The devices if the station was opened, else None."""
        return self._devices

    def now_ns(self) -> int:
        """The station's time; before it was opened, when the run begins: 0, or where it was cut off."""
        return self._begin_ns if self._devices is None else self._devices.clock.now_ns()

    def heed(self) -> None:
        """Raise what ends the run from outside: KeyboardInterrupt; DeviceFault where the log cannot be written."""
        self._check_interrupt()
        if (failure := self.log.failure) is not None:
            raise disk.not_written(self.log.path, failure.got, self.folder.path)

    def write(self, record: Record) -> None:
        """Put a record of the run into the log. Raises DeviceFault."""
        self.log.write_record(record)

    def event(self, level: str, text: str) -> None:
        """Tell the person, the log and events.jsonl; those of them that can still be told."""
        record = EventRecord(self.now_ns(), level, text)
        with suppress(DriverError):
            self.write(record)
        said = json.dumps({"t_ns": record.capture_ns, "level": level, "text": text}, ensure_ascii=False)
        with suppress(OSError), self.folder.events.open("a", encoding="utf-8") as file:
            file.write(said + "\n")
        self.progress.say(level, text)

    def save(self) -> None:
        """Write results.json as it stands. Raises OSError, and leaves what was there."""
        write_json(self.folder.results, self.results)

    def stage_done(self, number: int) -> None:
        """The stages before ``number`` are finished from now on, with all that they have found."""
        self.results["calibration"] = self.calibrations.told()
        self.results["progress"] = {
            "stage": number,
            "trials": len(self.results["trials"]),
            "t_ns": self.now_ns(),
        }
        self.save()

    def trial_done(self, row: dict[str, Any], *, finished: bool) -> None:
        """A trial's ``row`` for the results; one that is not ``finished`` is run again by a run that is resumed.

        What results.json calls finished is whole on the disk: the log comes before it.
        """
        self.results["trials"].append(row)
        if finished:
            self.note_health()
            with suppress(DriverError):  # a log that has failed ends the run after this
                self.log.drain()
            self.results["progress"]["t_ns"] = self.now_ns()
        self.save()

    @property
    def trials_done(self) -> int:
        """How many trials of the stage under way are finished already: none but in a run that was resumed."""
        return len(self.results["trials"]) - self.results["progress"]["trials"]
