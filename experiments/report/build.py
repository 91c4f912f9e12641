"""Writes a run's report."""

from __future__ import annotations

from experiments.progress import Heard, unheard
from experiments.report.collect import collect
from experiments.report.page import render
from experiments.run_folder import RunFolder, write_atomic


def build_report(folder: RunFolder, heard: Heard = unheard) -> None:
    """Write ``report.html`` from the log and the results of a run folder; ``heard`` as in `collect`.

    A fault campaign, which is a run as well, has a page of its own. Raises InputError.
    """
    from experiments.faults import report as faults

    data = collect(folder, heard)
    if faults.is_fault_campaign(data["results"]):
        from experiments.files import load

        page = faults.render(folder, load(str(folder.experiment)), data)
    else:
        page = render(data)
    write_atomic(folder.report, page)
