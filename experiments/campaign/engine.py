"""Runs jobs on Dask's workers: a local cluster, or somebody's scheduler. Scheduling and retries are Dask's.

What a job gave is read from its folder, so that a campaign which was cut off loses nothing that had ended.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast
from uuid import uuid4

import dask.config
from distributed import Client, Future, KilledWorker, LocalCluster, as_completed
from distributed.utils import silence_logging_cmgr
from rich.console import Console

from drivers.errors import NotConnected
from experiments.campaign.folder import CampaignFolder, JobFolder
from experiments.campaign.jobs import FAILED, Job, JobOutcome, examine, resolve
from experiments.campaign.progress import Tell, progress
from experiments.campaign.work import JobFailed, Unattended, Unsampled, work
from experiments.interrupt import Interrupt
from experiments.terminal import terminal
from mechanics.yaml_input import InputError, Problem

#: how long a scheduler may take to answer, and to have a worker [s]
PATIENCE = 10.0
#: how long a local cluster may take to start on a busy machine [s]
_START = 120.0
_LOCAL: dict[str, Any] = {
    "processes": True,
    "threads_per_worker": 1,
    "host": "127.0.0.1",
    "dashboard_address": None,
    # the scheduler has a web server even so: at a port of its own, where nobody has to find it
    "scheduler_kwargs": {"dashboard": False, "dashboard_address": "127.0.0.1:0"},
    "memory_limit": 0,  # a run keeps little, and a worker that is killed for others' memory helps nobody
    "silence_logs": logging.CRITICAL,
}


def run_jobs(
    jobs: Sequence[Job],
    folder: Path,
    *,
    workers: int = 2,
    scheduler: str | None = None,
    retries: int = 2,
    console: Console | None = None,
) -> list[JobOutcome]:
    """Run what has not ended yet of ``jobs``, each into ``folder/jobs/<id>``; how each of them ended, in their order.

    On ``workers`` processes of this machine, or on those of the Dask ``scheduler`` (``tcp://host:port``), which have to
    see ``folder`` under the same path. A job whose worker dies or whose devices fail is run again, ``retries`` times.

    Raises InputError and InfeasiblePlan before anything of a job is written or run, while workers may be starting;
    NotConnected when the scheduler goes or no worker comes; and KeyboardInterrupt. A campaign that was cut off goes on
    when it is started again.
    """
    console = console or terminal(stderr=True)
    if not jobs:
        return []
    campaign, resolved = CampaignFolder(folder), resolve(jobs)
    asked = campaign.agree(jobs, resolved)
    missing = [job for job in jobs if campaign.job(job.id).ended() is None]
    if missing:
        with Interrupt() as interrupt, _client(scheduler, min(workers, len(missing)), retries) as client:
            try:
                examine(missing, resolved)  # while the workers start and import
                campaign.keep(asked, jobs, resolved)
                _await_worker(client)
                with progress(console, len(jobs), len(jobs) - len(missing)) as tell:
                    _run(client, missing, campaign, retries, tell)
            finally:
                interrupt.closing()
    return [_outcome(campaign, job) for job in jobs]


def _run(client: Client, jobs: Sequence[Job], campaign: CampaignFolder, retries: int, tell: Tell) -> None:
    here, name, attempts = str(Path.cwd()), f"extrinsic-{uuid4().hex[:12]}", {}
    where = client.scheduler_info()["address"]
    waiting: dict[Future, Job] = {}
    for job in jobs:
        folder = campaign.job(job.id)
        folder.try_again()
        attempts[job.id] = len(folder.runs())
        key = f"{name}-{job.id}"
        waiting[client.submit(work, str(folder.path), here, key=key, pure=False, retries=retries)] = job
    for future in as_completed(list(waiting), loop=client.loop):
        job = waiting.pop(future)
        folder = campaign.job(job.id)
        ended = folder.ended()
        if ended is None and future.status in ("cancelled", "lost"):
            remedy = "Start the sweep again with the same --out: it goes on with what is missing"
            raise NotConnected(f"scheduler {where}", f"run {job.id}", "it has gone", remedy)
        if ended is None:
            reason = _reason(future, folder)
            folder.give_up(reason)
            tell(f"{job.id} ({job.told}): {FAILED}: {reason}")
        else:
            tries = len(folder.runs()) - attempts[job.id]
            again = f", at attempt {tries}" if tries > 1 else ""
            status = ended[1]["status"]
            tell(f"{job.id} ({job.told}): {status}{again}" if again or status != "completed" else "")
        future.release()  # the scheduler may forget it


def _reason(future: Future, folder: JobFolder) -> str:
    """Why no attempt came to an end: as the last one's results say, or as the worker does."""
    if (told := folder.told()) is not None:
        return told
    error = future.exception()
    if error is None:  # the worker saw it end, and it is not to be seen from here
        return "its results are not here: do all workers share the sweep's file system?"
    if isinstance(error, KilledWorker):
        return "its worker died at every attempt"
    return str(error) if isinstance(error, JobFailed) else f"{type(error).__name__}: {error}"


def _outcome(campaign: CampaignFolder, job: Job) -> JobOutcome:
    folder = campaign.job(job.id)
    runs = folder.runs()
    ended = folder.ended()
    if ended is not None:
        return JobOutcome(job, ended[1]["status"], ended[1]["reason"], ended[0], len(runs))
    return JobOutcome(job, FAILED, folder.failure or "", runs[-1] if runs else None, len(runs))


@contextmanager
def _client(scheduler: str | None, workers: int, retries: int) -> Iterator[Client]:
    """A client of the scheduler, or of a local cluster that ends with it."""
    if scheduler is not None:
        with _remote(scheduler) as client:
            yield client
        return
    settings = {
        "distributed.scheduler.allowed-failures": retries,
        "distributed.scheduler.worker-saturation": 1.0,  # a worker that dies takes no job with it but the one it runs
        "distributed.worker.multiprocessing-method": "spawn",
        "distributed.comm.timeouts.connect": f"{_START:g}s",
        "distributed.nanny.preload": [],
        "distributed.worker.preload": [],
        # nobody looks at what Dask tells of itself, a job has to wait for each look, and see `Unsampled`
        "distributed.worker.profile.enabled": False,
        "distributed.admin.tick.interval": "1s",
    }
    with (
        tempfile.TemporaryDirectory(prefix="extrinsic-sweep-", ignore_cleanup_errors=True) as scratch,
        dask.config.set({**settings, "temporary-directory": scratch}),
        LocalCluster(**_LOCAL, n_workers=0, local_directory=scratch) as cluster,
        Client(cluster, timeout=_START, set_as_default=False) as client,
    ):
        client.register_plugin(Unattended())
        cast("Any", cluster).scale(workers)  # does not wait for them
        yield client


def _await_worker(client: Client) -> None:
    """Wait for the first worker. Raises NotConnected."""
    try:
        client.wait_for_workers(1, timeout=_START)
    except TimeoutError:
        asked, got = "start its workers", f"none came within {_START:g} s"
        raise NotConnected("this machine", asked, got, "Ask for fewer `--workers`, or free some memory") from None


def reach(scheduler: str) -> None:
    """Raises InputError, within a bounded time, where ``scheduler`` does not answer or has no worker."""
    with _remote(scheduler):
        pass


@contextmanager
def _remote(scheduler: str) -> Iterator[Client]:
    """A client of a scheduler that answers and has a worker. Raises InputError within a bounded time."""

    def refused(wrong: str, remedy: str) -> InputError:
        return InputError([Problem(f"--scheduler {scheduler}", None, "", wrong, remedy)])

    try:
        client = Client(scheduler, timeout=PATIENCE, set_as_default=False)
    except OSError:
        remedy = "the address of a running `dask scheduler`, or leave it out for a cluster on this machine"
        raise refused(f"nothing answers there within {PATIENCE:g} s", remedy) from None
    except ValueError as error:
        raise refused(f"is no address: {error}", "tcp://host:port") from None
    with silence_logging_cmgr(logging.CRITICAL), client:  # what goes wrong is told once, by us
        try:
            client.wait_for_workers(1, timeout=PATIENCE)
        except TimeoutError:
            remedy = f"start one where extrinsic is installed: dask worker {scheduler} --nthreads 1"
            raise refused(f"it has no worker after {PATIENCE:g} s", remedy) from None
        client.register_plugin(Unsampled())
        yield client
