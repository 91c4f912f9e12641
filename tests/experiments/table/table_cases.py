"""A small table, and an engine that makes trials up instead of running them."""

import json
from dataclasses import dataclass, field

import pandas as pd
from rich.console import Console

from experiments.calibrate.store import Calibrations
from experiments.campaign.jobs import JobOutcome
from experiments.files import load
from experiments.planning.make import make
from experiments.schema import ExecuteStage
from experiments.setup import believed
from experiments.table.measure import Engine
from planning import plan_file

SMALL = """\
name: small
title: A small table
set: {world.profile: lab, stages.0.parameters.steps: 3}
calibrations:
  - name: hand
    set: {stages: [{stage: calibrate_clock}]}
  - name: rough
    after: hand
    set: {stages: [{stage: calibrate_friction, pair: go-ground}]}
controllers: [open_loop, closed_loop]
trials: 2
runs:
  - name: static
    experiment: grasped_static
    calibration: rough
    tags: {skill: static}
  - name: slow
    experiment: grasped_static
    tags: {skill: static}
    set: {trial.ramp: 0.5}
    trajectories:
      - {name: a, set: {}}
      - {name: b, set: {stages.0.parameters.angle_deg: 20}}
paper:
  at: grasped.{skill}.{controller}
panels:
  - rows: [controller]
    across: [run]
    figures: [wrench_N, go_pose_mm]
comparisons:
  - {name: closed − open, figure: wrench_N, each: [run], a: {controller: closed_loop}, b: {controller: open_loop}}
counts:
  - {name: done, of: trials completed}
  - {name: below, of: cells at or below the paper, where: {controller: closed_loop}}
figures:
  - {name: wrench of open loop, figure: wrench_N, where: {controller: open_loop, run: static}}
"""


def row(job, controller, trial, wrench=0.5, pose=1.0, status="completed", ran=True, **others):
    """A trial's row as a campaign's frame has it."""
    figures = {
        f"{witness}.{key}.{part}": value
        for witness in ("measured", "truth")
        for key, mean in {"wrench_N": wrench, "go_pose_mm": pose}.items()
        for part, value in (("mean", mean), ("std", 0.1))
    }
    known = {"name": "t", **figures} if ran else {}
    return {"job": job, "controller": controller, "trial": trial, "status": status, "reason": "", **known, **others}


@dataclass
class Made:
    """Every campaign that was asked for: its folder's name, and its jobs as they were resolved."""

    campaigns: list = field(default_factory=list)
    resolved: dict = field(default_factory=dict)
    ends: dict = field(default_factory=dict)
    status: dict = field(default_factory=dict)
    finds_nothing: bool = False
    wrench: dict = field(default_factory=lambda: {"open_loop": 1.0, "closed_loop": 0.4})

    @property
    def order(self):
        return [(folder, [job.id for job in jobs]) for folder, jobs in self.campaigns]

    def engine(self):
        return Engine(run=self.run, frame=self.frame)

    def run(self, jobs, folder, *, workers, scheduler, console):
        assert isinstance(console, Console) and workers == 2 and scheduler is None
        self.campaigns.append((folder.name, list(jobs)))
        return [self._outcome(job, folder) for job in jobs]

    def _outcome(self, job, folder):
        resolved = self.resolved[job.id] = load(job.experiment, job.station, job.sets)
        place = folder / "jobs" / job.id
        run = place / "run"
        run.mkdir(parents=True, exist_ok=True)
        (place / "calibrations").mkdir(exist_ok=True)
        names = (resolved.experiment.calibration.source, f"found-by-{job.id}")
        for known in () if self.finds_nothing else names:
            (place / "calibrations" / f"{known.rpartition('/')[2]}.yaml").write_text(f"by: {job.id}\n")
        plans = []
        for stage in resolved.experiment.stages:
            if stage.stage == "plan":
                (run / "plans").mkdir(exist_ok=True)
                file = f"plans/{stage.name}.npz"
                plan_file.save(make(resolved, stage, believed(resolved, Calibrations())), run / file)
                plan = {"name": stage.name, "time_s": 0.25, "loss": 0.1, "queries": 3, "status": "solved", "file": file}
                plans.append(plan)
        status = self.ends.get(job.id, "completed")
        (run / "results.json").write_text(json.dumps({"status": status, "reason": "why", "trials": [], "plans": plans}))
        return JobOutcome(job, status, "why", run, 1)

    def frame(self, folder):
        rows = []
        for job in dict(self.campaigns)[folder.name]:
            for stage in self.resolved[job.id].experiment.stages:
                if isinstance(stage, ExecuteStage):
                    rows += self._rows(job.id, stage)
        return pd.DataFrame(rows)

    def _rows(self, job, stage):
        ended = self.ends.get(job) == "stopped"
        for n, name in enumerate(stage.controllers):
            if (ended and n) or self.ends.get(
                job
            ) == "failed":  # as a campaign has the trials that a job did not get to
                yield row(job, name, stage.first, status=self.ends[job], ran=False)
            else:
                status = "stopped" if ended else self.status.get(job, "completed")
                yield row(job, name, stage.first, self.wrench[name] + 0.01 * stage.first, status=status)
