"""The stages an experiment is made of: each takes the run's context and does one thing."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib import import_module
from typing import Any

from control.base import Controller
from control.trial import Trial, TrialResult, Watch
from drivers.errors import DriverError, SimulationDiverged
from drivers.station import Devices
from experiments import registries, setup
from experiments.context import RunContext
from experiments.metrics import errors_of
from experiments.schema import ExecuteStage, PlanStage, Stage
from mechanics.records import PhaseRecord, PlanarState, TrialRecord, WaypointRecord
from planning.plan import Plan


def plan_stage(context: RunContext, stage: PlanStage) -> None:
    """Make the plan that later stages execute. Raises InfeasiblePlan."""
    from planning.planner import plan

    begin = time.perf_counter()
    with context.progress.step(f"plan {stage.name}"):
        made = plan(setup.task(context.resolved, stage, context.believed), stage.name, backend=stage.backend)
    context.plans[stage.name] = made
    context.results["plans"].append(
        {
            "name": made.name,
            "skill": made.skill,
            "planner": made.planner,
            "steps": len(made.ee),
            "queries": made.queries,
            "time_s": time.perf_counter() - begin,
            "loss": made.loss,
            "status": made.status,
        }
    )


def execute_stage(context: RunContext, stage: ExecuteStage) -> None:
    """Run ``trials`` trials of the plan under each controller. A trial that fails does not end the stage.

    A device that fails does: what cannot be commanded any more is not tried again.
    """
    plan = context.plans[stage.plan]
    devices = context.devices()
    with devices.arm.lease(context.holder), context.timed(devices):
        for trial in range(stage.trials):
            for name in stage.controllers:
                result = _one_trial(context, devices, plan, registries.controllers()[name], trial)
                if result.status in ("device_failed", "stopped", "diverged"):
                    return


def _one_trial(
    context: RunContext, devices: Devices, plan: Plan, controller: type[Controller], trial: int
) -> TrialResult:
    name = f"{plan.name}-{controller.name}-{trial}"
    begin = TrialRecord(devices.clock.now_ns(), name, plan.skill, controller.name)
    context.write(begin)
    waypoints: list[WaypointRecord] = []
    with context.progress.steps(f"{controller.name} {trial + 1}", len(plan.ee)) as advance:

        def on_waypoint(record: WaypointRecord) -> None:
            witnessed = replace(record, truth=_truth(devices))
            waypoints.append(witnessed)
            context.write(witnessed)
            advance()

        watch = Watch(
            waypoint=on_waypoint,
            tick=context.check_interrupt,
            phase=lambda phase, _fraction: context.write(PhaseRecord(devices.clock.now_ns(), name, phase)),
            event=lambda level, text: context.event(level, f"{name}: {text}"),
            reset_scene=context.ask if devices.simulation is None else lambda _what: False,
        )
        clock, load = devices.clock, setup.free_air_load(context.resolved)
        try:
            if devices.simulation is not None:
                devices.simulation.regrasp(trial)
            observer = setup.observer(context.resolved, devices, context.settings, context.believed, context.fingers())
            result = Trial(name, plan, controller, observer, clock, load, context.settings, watch).run()
        except SimulationDiverged as error:
            result = TrialResult("diverged", str(error), plan)
        except DriverError as error:  # before the protocol began
            result = TrialResult("device_failed", str(error), plan)
    context.results["trials"].append(_row(context, name, controller.name, trial, result, waypoints))
    end = replace(begin, status=result.status, reason=result.reason, plan=json.dumps(result.plan.to_dict()))
    context.write(replace(end, capture_ns=context.now_ns()))
    context.save()
    return result


def _truth(devices: Devices) -> PlanarState | None:
    if devices.simulation is None:
        return None
    truth = devices.simulation.truth()
    return PlanarState(truth.ee, truth.go, truth.eo, truth.wrench)


def _row(
    context: RunContext, name: str, controller: str, trial: int, result: TrialResult, waypoints: list[WaypointRecord]
) -> dict[str, Any]:
    grasped, extrinsic = context.resolved.grasped, context.resolved.extrinsic
    rho_go = grasped.polygon.radius_of_gyration
    rho_eo = None if extrinsic is None else extrinsic.polygon.radius_of_gyration
    return {
        "name": name,
        "skill": result.plan.skill,
        "planner": result.plan.planner,
        "controller": controller,
        "grasped_object": grasped.name,
        "extrinsic_object": None if extrinsic is None else extrinsic.name,
        "sensor": context.resolved.sensor.name,
        "trial": trial,
        "status": result.status,
        "reason": result.reason,
        **{witness: errors_of(waypoints, witness, rho_go, rho_eo, rho_go) for witness in ("measured", "truth")},
    }


def _calibration(module: str) -> Callable[[RunContext, Any], None]:
    """The stage ``<module>_stage`` of ``experiments.calibrate.<module>``, imported when it runs: its fits are heavy."""

    def run(context: RunContext, stage: Any) -> None:
        getattr(import_module(f"experiments.calibrate.{module}"), f"{module}_stage")(context, stage)

    return run


_CALIBRATIONS = ("force_torque", "elasticity", "friction", "camera", "clock")


def has_diverged(trials: list[dict[str, Any]]) -> bool:
    """Whether the simulated world is nonsense by now: it has diverged in a trial, and only a reset would mend it."""
    return any(trial["status"] == "diverged" for trial in trials)


def skip_stages(context: RunContext, stages: Sequence[Stage]) -> None:
    """Note among the results which stages do not run any more, and why: how the last trial ended.

    A reset within a run would mend a diverged world, but its stamps would begin at 0 again, and the log run backwards.
    """
    last = context.results["trials"][-1]
    reason = f"{last['name']} ended as {last['status']}"
    for stage in stages:
        name = getattr(stage, "name", None) or getattr(stage, "plan", "")
        context.results["not_run"].append({"stage": stage.stage, "name": name, "reason": reason})
        context.event("warning", f"{f'{stage.stage} {name}'.strip()}: not run, for {reason}")


STAGES: dict[str, Callable[[RunContext, Any], None]] = {
    "plan": plan_stage,
    "execute": execute_stage,
    **{f"calibrate_{name}": _calibration(name) for name in _CALIBRATIONS},
}
