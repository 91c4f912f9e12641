"""Campaigns as jobs leave them on disk, made up: no run, no simulation."""

import json


def row(controller, trial, status, wrench):
    figures = None if wrench is None else {"wrench_N": {"mean": wrench, "std": 0.1}, "eo_pose_mm": None}
    names = {"skill": "grasped_static", "controller": controller, "trial": trial, "sensor": "soft_bubble"}
    return {**names, "status": status, "reason": "", "measured": figures, "truth": None}


def campaign(path, jobs):
    """A folder as jobs leave it: ``jobs`` are (id, tags, planned rows, runs), a run (status, rows)."""
    told = [{"id": id, "tags": tags, "trials": planned} for id, tags, planned, _ in jobs]
    path.mkdir(parents=True)
    (path / "campaign.json").write_text(json.dumps({"schema": 1, "experiment": "e", "jobs": told}))
    for id, _, _, runs in jobs:
        for number, (status, rows) in enumerate(runs):
            run = path / "jobs" / id / (f"run.{number}" if number else "run")
            run.mkdir(parents=True)
            (run / "results.json").write_text(json.dumps({"status": status, "reason": "so", "trials": rows}))
    return path
