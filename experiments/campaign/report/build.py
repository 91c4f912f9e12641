"""Writes a campaign's report, and what it is made of."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pandas import DataFrame

from experiments import disk
from experiments.campaign import frame
from experiments.campaign.folder import CampaignFolder
from experiments.campaign.report.collect import collect
from experiments.campaign.report.page import render
from experiments.campaign.summary import status_of, summarise
from experiments.run_folder import write_atomic

REPORT = "report.html"


def rebuild(folder: Path) -> Path:
    """Write table, summary and report of the campaign in ``folder`` anew, from its jobs; the report's place.

    Also of one that was cut off or killed. Raises InputError where there is no campaign, DeviceFault where they cannot
    be written.
    """
    campaign = CampaignFolder(folder)
    summary, trials = summarise(campaign, status_of(campaign))
    try:
        frame.save(folder, summary, trials)
        return write_report(campaign, summary, trials)
    except OSError as error:
        raise disk.not_kept(error, folder, f"extrinsic report {folder}") from None


def write_report(campaign: CampaignFolder, summary: Mapping[str, Any], trials: DataFrame) -> Path:
    """Write ``report.html`` into the campaign's folder; its place. Raises OSError."""
    path = campaign.path / REPORT
    write_atomic(path, render(collect(campaign, summary, trials)))
    return path
