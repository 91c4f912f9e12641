"""Rehearses the plans of an experiment in free air, in place of its trials: ``--rehearse``."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np

from control.rehearsal import Rehearsal
from control.trial import Watch
from drivers.station import Devices
from experiments import setup
from experiments.arrange import arrange
from experiments.context import RunContext
from mechanics import se2
from mechanics.records import PhaseRecord
from planning.plan import Plan

#: at least so far above where the plan is to be executed [m]
LIFT = 0.05


def rehearse(context: RunContext, devices: Devices, plan: Plan) -> None:
    """Take the arm through the whole motion of a plan, lifted clear of table and object; a row for the results."""
    name = f"{plan.name}-rehearsal"

    def tell(level: str, text: str) -> None:
        context.event(level, f"{name}: {text}")

    def phase(what: str, _fraction: float) -> None:
        context.write(PhaseRecord(devices.clock.now_ns(), name, what))

    with context.progress.step(f"rehearse {plan.name}"):
        arrange(context, devices, plan, 0)
        observer = setup.observer(context.resolved, devices, context.settings, context.believed, ())
        watch = Watch(phase=phase, event=tell, tick=context.heed)
        load = setup.free_air_load(context.resolved)
        lift = LIFT + _height(context, plan)
        found = Rehearsal(plan, lift, observer, devices.clock, load, context.settings, watch).run()
    tell("info", f"{found.status}, {lift * 1e3:.0f} mm above the trial, at most {found.force:.2f} N on the object")
    context.results.setdefault("rehearsals", []).append({"name": name, "plan": plan.name, **asdict(found)})


def _height(context: RunContext, plan: Plan) -> float:
    """How high the extrinsic object stands in the course of the plan [m]; 0 without one."""
    if plan.eo is None or context.resolved.extrinsic is None:
        return 0.0
    corners = np.asarray(context.resolved.extrinsic.polygon.vertices)
    poses = np.concatenate([plan.eo, *(p for p in (plan.preload_eo, plan.unload_eo) if p is not None)])
    return float(max(se2.transform(pose, corners)[:, 1].max() for pose in poses))
