"""A run in a process of its own that is killed at a chosen moment: as ``python doomed.py RUN EXPERIMENT MOMENT``.

The run is begun, or resumed where it has begun already. MOMENT is ``never`` or one of `MOMENTS` with the occurrence
from 1, such as ``contact:2``. With a fourth argument, a file, each step of the station's clock, a control tick mostly,
leaves its wall time and its station time there before and after, two integers of 8 bytes [ns] each. The exit code is
the run's.
"""

import os
import signal
import struct
import sys
import time
from pathlib import Path

from rich.console import Console

from drivers.hosting import HostProcess
from drivers.sim.host_thread import HostThread
from drivers.wire.clock import RemoteClock
from experiments import kernels, runner
from experiments.context import RunContext
from experiments.files import load
from experiments.planning import stage as plan_stage
from experiments.resume import resume
from mechanics.records import PhaseRecord, TrialRecord

TICK = struct.Struct("<qq")


def _die_after(owner, name, occurrence, when=lambda *_: True):
    """Kill this process, as nothing can prevent, when ``owner.name`` has returned so often with such arguments."""
    original, seen = getattr(owner, name), 0

    def doomed(*arguments, **options):
        nonlocal seen
        result = original(*arguments, **options)
        seen += when(*arguments)
        if seen == occurrence:
            os.kill(os.getpid(), signal.SIGKILL)
        return result

    setattr(owner, name, doomed)


def _in_contact(_context, record):
    return isinstance(record, PhaseRecord) and record.phase == "trajectory"


def _ending(_context, record):
    return isinstance(record, TrialRecord) and bool(record.status)


MOMENTS = {
    #: the plan lies in the folder, and results.json does not know of it
    "plan": lambda n: _die_after(plan_stage, "save_plan", n),
    #: a calibration has left its files, and results.json does not know of it
    "calibration": lambda n: _die_after(RunContext, "calibrated", n),
    #: at a waypoint
    "contact": lambda n: _die_after(RunContext, "write", n, _in_contact),
    #: the log has a trial's end, and results.json has not
    "end": lambda n: _die_after(RunContext, "write", n, _ending),
    #: results.json has a trial
    "trial": lambda n: _die_after(RunContext, "trial_done", n),
}


def _tell_ticks(path):
    file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    sleep = RemoteClock.sleep

    def told(clock, seconds):
        os.write(file, TICK.pack(time.time_ns(), clock.now_ns()))
        sleep(clock, seconds)
        os.write(file, TICK.pack(time.time_ns(), clock.now_ns()))

    setattr(RemoteClock, "sleep", told)  # noqa: B010


def main(run, experiment, moment, ticks=""):
    """Run it, and die on the way."""
    kernels.keep()
    name, _, occurrence = moment.partition(":")
    if name != "never":
        MOMENTS[name](int(occurrence or 1))
    if ticks:
        _tell_ticks(ticks)
    folder, console = Path(run), Console(stderr=True)
    host = HostProcess if ticks else HostThread  # a process of its own has to be looked for before it dies, too
    if (folder / "experiment.yaml").is_file():
        return int(resume(folder, console=console, host=host).exit_code)
    return int(runner.run(load(experiment), folder, console, host).exit_code)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
