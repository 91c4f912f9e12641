"""What a run carries from stage to stage: its files, its plans, its results, and the station once it is needed."""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from control.observe import Finger
from control.settings import TrialSettings
from drivers.hosting import HostProcess
from drivers.station import Devices, Hosting, Station
from drivers.wire.log import LogWriter
from experiments import setup
from experiments.calibrate import store
from experiments.calibrate.models import Calibration
from experiments.calibrate.store import Calibrations
from experiments.files import Resolved
from experiments.progress import Progress
from experiments.run_folder import RunFolder, write_json
from mechanics.records import EventRecord, PhaseRecord, TrialRecord, WaypointRecord
from planning.plan import Plan
from planning.skills.base import SkillTask

#: the streams have spoken before the first stage needs them [s]
WARM_UP = 0.2

Record = EventRecord | PhaseRecord | TrialRecord | WaypointRecord


class RunContext:
    """One run. ``closing`` holds what has to be closed in order, however it ends; ``host`` as `runner.run` has it."""

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
        self.ask, self.check_interrupt = ask, check_interrupt
        self._closing, self._host = closing, host
        self._devices: Devices | None = None
        self._fingers: tuple[Finger, ...] | None = None

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
                    )
                devices.clock.sleep(WARM_UP)
            self._devices = devices
        return self._devices

    def fingers(self) -> tuple[Finger, ...]:
        """The tactile fingers, where controllers are to feel; they are made ready at the first call."""
        if setup.go_pose(self.resolved, self.calibrations) != "tactile":
            return ()
        if self._fingers is None:
            from experiments.fingers import fingers

            self._fingers = fingers(self.resolved, self.devices())
        return self._fingers

    @property
    def believed(self) -> setup.Believed:
        """What this run takes for true, by what has been calibrated until now."""
        return setup.believed(self.resolved, self.calibrations)

    def calibrated(self, calibration: Calibration) -> None:
        """Keep what a stage has found: for the later stages, in the run folder, and for later runs on this station."""
        store.save(self.folder.calibration, calibration)
        file = store.save(store.folder_of(self.resolved), calibration)
        self.calibrations.add(calibration, file)
        self.results["calibration"] = self.calibrations.told()
        self.save()

    @contextmanager
    def timed(self, devices: Devices) -> Iterator[None]:
        """Add wall time and station time of the block to the results, whatever ends it."""
        wall, station_ns = time.perf_counter(), devices.clock.now_ns()
        try:
            yield
        finally:
            timing = self.results["timing"]
            timing["execute_wall_s"] += time.perf_counter() - wall
            timing["execute_station_s"] += (devices.clock.now_ns() - station_ns) * 1e-9

    @property
    def opened(self) -> Devices | None:
        """The devices if the station was opened, else None."""
        return self._devices

    def now_ns(self) -> int:
        """The station's time; 0 before it was opened."""
        return 0 if self._devices is None else self._devices.clock.now_ns()

    def write(self, record: Record) -> None:
        """Put a record of the run into the log."""
        self.log.write_record(record)

    def event(self, level: str, text: str) -> None:
        """Tell the person, the log and events.jsonl."""
        record = EventRecord(self.now_ns(), level, text)
        self.write(record)
        with self.folder.events.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"t_ns": record.capture_ns, "level": level, "text": text}, ensure_ascii=False) + "\n")
        self.progress.say(level, text)

    def save(self) -> None:
        """Write results.json as it stands."""
        write_json(self.folder.results, self.results)
