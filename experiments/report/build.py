"""Writes a run's report."""

from __future__ import annotations

from experiments.progress import Heard, unheard
from experiments.report.collect import collect
from experiments.report.page import render
from experiments.run_folder import RunFolder, write_atomic


def build_report(folder: RunFolder, heard: Heard = unheard) -> None:
    """Write ``report.html`` from the log and the results of a run folder; ``heard`` as in `collect`.

    Raises InputError.
    """
    write_atomic(folder.report, render(collect(folder, heard)))
