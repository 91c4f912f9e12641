"""What a campaign has come to, as its folder shows: how it stands, the table of its trials, and what they come to."""

from __future__ import annotations

from typing import Any

from pandas import DataFrame
from pydantic import BaseModel

from experiments.campaign import frame
from experiments.campaign.folder import CampaignFolder
from experiments.results_file import Word, read_json

#: what a sweep that did not come to its end has said of itself; of one that was killed there is no word
CUT_OFF = ("interrupted", "scheduler_failed")
UNFINISHED = "unfinished"


class _Summary(BaseModel):
    status: Word


def status_of(campaign: CampaignFolder) -> str:
    """``completed``, ``fell_short``, or, where jobs are missing, why as far as it was said.

    Raises InputError where there is no campaign.
    """
    jobs = [campaign.job(job["id"]) for job in campaign.read()["jobs"]]
    ended = [job.ended() for job in jobs]
    if all(found is not None or job.failure is not None for found, job in zip(ended, jobs, strict=True)):
        whole = all(found is not None and found[1]["status"] == "completed" for found in ended)
        return "completed" if whole else "fell_short"
    told = read_json(campaign.path / frame.SUMMARY, _Summary)
    return told["status"] if told is not None and told["status"] in CUT_OFF else UNFINISHED


def summarise(campaign: CampaignFolder, status: str) -> tuple[dict[str, Any], DataFrame]:
    """What summary.json says, and the table of all trials. Raises InputError where there is no campaign."""
    told, trials = campaign.read(), frame.trials_frame(campaign.path)
    folders = {job["id"]: campaign.job(job["id"]) for job in told["jobs"]}
    failed = [
        {"id": job["id"], "tags": job["tags"], "reason": failure}
        for job in told["jobs"]
        if (failure := folders[job["id"]].failure) is not None
    ]
    summary = {
        "schema": 1,
        "status": status,
        "experiment": told.get("experiment"),
        "jobs": len(told["jobs"]),
        "ended": sum(folder.ended() is not None for folder in folders.values()),
        "failed": failed,
        "trials": len(trials),
        "cells": frame.cells(campaign.path, trials),
        "comparisons": frame.comparisons(campaign.path, trials),
    }
    return summary, trials
