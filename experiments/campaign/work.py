"""What a worker does with a job. All that passes through the scheduler is the name of the job's folder.

A worker imports and compiles at its first job and keeps it for the others. It hosts its simulated station itself, in a
thread: a process for each job would begin with the imports of the simulation.
"""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
from contextlib import chdir, suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from distributed import Worker, WorkerPlugin

if TYPE_CHECKING:
    from drivers.station import Hosting
    from experiments.files import Resolved

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")

#: jobs are run one at a time in a process, whatever number of threads its worker has: the current folder is shared
_ALONE = threading.Lock()


class JobFailed(Exception):
    """The run did not come to its end: a device failed, nobody has foreseen what happened, or this worker cannot work.

    Another attempt may do better.
    """


class Unattended(WorkerPlugin):
    """A worker that leaves Ctrl-C to the process that started it, which closes its workers in order.

    It imports what jobs need while it waits for the first.
    """

    name = "extrinsic-unattended"
    idempotent = True

    def setup(self, worker: Worker) -> None:
        """Ignore SIGINT, where this is a process of its own."""
        if threading.current_thread() is threading.main_thread() and worker.nanny is not None:
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            threading.Thread(target=_prepare_alone, name="prepare", daemon=True).start()


class Unsampled(WorkerPlugin):
    """A worker whose threads nobody samples, whoever started it.

    CPython 3.11 lists its threads with a lock held. A garbage collection in the midst of that may give the interpreter
    away (Dask looks at collections, too), and who starts a thread then waits for the lock, for ever: all stand still.
    """

    name = "extrinsic-unsampled"
    idempotent = True

    def setup(self, worker: Worker) -> None:
        """Stop Dask's profiler."""
        for name in ("profile", "profile-cycle"):
            if (callback := worker.periodic_callbacks.pop(name, None)) is not None:
                callback.stop()


def work(job: str, here: str) -> str:
    """Run the job in the folder ``job`` into a new run folder, with ``here`` as the current folder; the run's name.

    A job that has ended already is left as it is: a worker may die between its last file and its answer. Raises
    JobFailed when a device failed or an exception came that nobody has foreseen.
    """
    path = Path(job)
    if not path.is_dir() or not Path(here).is_dir():
        raise JobFailed(f"{socket.gethostname()} does not see {path}: let all workers share the sweep's file system")
    with _ALONE, chdir(here):
        _prepare()
        return _run(path)


def _prepare_alone() -> None:
    with _ALONE, suppress(Exception):  # the first job meets it again, and says so
        _prepare()


@cache
def _prepare() -> None:
    """One thread for each library, those that a job will import among them; and what every job needs."""
    os.environ.update(dict.fromkeys(THREADS, "1"))
    from experiments import kernels

    kernels.keep()
    from threadpoolctl import threadpool_limits

    from drivers.sim import tag_camera, world  # noqa: F401
    from experiments import runner  # noqa: F401

    threadpool_limits(limits=1)
    if (torch := sys.modules.get("torch")) is not None:  # imported later, it goes by the environment
        torch.set_num_threads(1)


def _run(path: Path) -> str:
    from rich.console import Console

    from drivers.sim import host_thread
    from experiments import runner
    from experiments.campaign.folder import JobFolder
    from experiments.exit_codes import ExitCode
    from experiments.files import load

    folder = JobFolder(path)
    if (ended := folder.ended()) is not None:
        return ended[0].name
    run = folder.next_run()
    with run.with_name(f"{run.name}.log").open("w", encoding="utf-8") as said:
        resolved = _on_its_own(load(str(folder.experiment)))
        outcome = runner.run(resolved, run, Console(file=said, width=120), _host(resolved))
    if host_thread.stuck():  # it takes the processor from whatever runs here next; a new worker does not
        os.kill(os.getpid(), signal.SIGKILL)
    if outcome.exit_code in (ExitCode.DEVICE_FAILED, ExitCode.FAILED, ExitCode.INTERRUPTED):
        raise JobFailed(outcome.reason)
    return run.name


def _host(resolved: Resolved) -> Hosting:
    """Where a simulated station runs: here, or in a process of its own, if it has to keep the pace of the wall."""
    from drivers.hosting import HostProcess
    from drivers.sim.host_thread import HostThread

    world = resolved.station.world
    return HostThread if world is not None and world.clock == "lockstep" else HostProcess


def _on_its_own(resolved: Resolved) -> Resolved:
    """A simulated station at an endpoint that nobody else uses; a laboratory's is where it is."""
    from experiments.ports import own_bus

    station = resolved.station
    if station.world is None or any(device.backend != "sim" for device in station.devices.values()):
        return resolved
    return replace(resolved, station=station.model_copy(update={"bus": own_bus(station.bus)}))
