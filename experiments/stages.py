"""The stages an experiment is made of: each takes the run's context and does one thing."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from importlib import import_module
from typing import Any

from control.base import Controller
from control.observe import Finger
from control.reads import Reads
from control.trial import Trial, TrialResult, Watch
from drivers.errors import DeviceTimeout, DriverError, SimulationDiverged
from drivers.station import Devices
from experiments import kernels, looks, registries, setup
from experiments.arrange import arrange, let_go
from experiments.context import RunContext
from experiments.faults.inject import Injector
from experiments.metrics import contact_of, errors_of, finger_slip_of, witness_of
from experiments.planning.stage import plan_stage, take_plan_files
from experiments.rehearse import rehearse
from experiments.schema import ExecuteStage, Stage
from experiments.suspend import TRIES, Suspender
from mechanics.records import PhaseRecord, PlanarState, TrialRecord, WaypointRecord
from planning.plan import Plan

#: how long fingers that do not answer yet are asked for their untouched pictures before the first trial [s]
PATIENCE = 30.0
#: statuses of trials that a resumed run repeats: what ended them was not the trial's own doing
CUT_OFF = ("device_failed", "stopped")


def execute_stage(context: RunContext, stage: ExecuteStage) -> None:
    """Run ``trials`` trials of the plan under each controller. A trial that fails does not end the stage.

    A device that fails does: what cannot be commanded any more is not tried again.
    """
    if stage.from_file:
        take_plan_files(context)
    plan = context.plans[stage.plan]
    if stage.restiffen:
        plan = plan.with_stiffness(context.believed.stiffness)
    trials = [(trial, name) for trial in range(stage.first, stage.first + stage.trials) for name in stage.controllers]
    left = trials[context.trials_done :]
    if not left:  # it was cut off right after the last one
        return
    devices = context.devices()
    _warm_up(context, stage)
    with devices.arm.lease(context.holder), context.timed(devices):
        if context.resolved.experiment.rehearse:
            rehearse(context, devices, plan)
            return
        suspender = Suspender(context, devices)
        for trial, name in left:
            result = _tried(context, devices, plan, registries.controllers()[name], stage, trial, suspender)
            context.heed()
            if result.status in (*CUT_OFF, "diverged"):
                return


def _tried(
    context: RunContext,
    devices: Devices,
    plan: Plan,
    controller: type[Controller],
    stage: ExecuteStage,
    trial: int,
    suspender: Suspender,
) -> TrialResult:
    """Run a trial once the sensors are well, and again where one that cut it off has come back."""
    attempt = 1
    while True:
        suspender.checkpoint()
        result = _one_trial(context, devices, plan, controller, stage, trial)
        if result.status != "device_failed" or attempt == TRIES or not suspender.has_come_back(result.device):
            return result
        context.results["trials"].pop()
        attempt += 1


def _warm_up(context: RunContext, stage: ExecuteStage) -> None:
    """Have everything compiled that a trial estimates with, the simulated fingers' renderer included."""
    fingers: tuple[Finger, ...] = ()
    if any(registries.controllers()[name].feedback for name in stage.controllers):
        patience = time.monotonic() + PATIENCE
        while time.monotonic() < patience:
            try:
                fingers = context.fingers()
                break
            except DeviceTimeout:
                continue
            except DriverError:  # the trial will meet it again, and name it
                break
    reads = Reads()
    reads.begin()
    setup.warm_up(context.resolved, context.believed, fingers, reads)
    looks.write(context, "", "warm_up", {}, reads.end())
    if any(registries.controllers()[name].needs_task for name in stage.controllers):
        kernels.warm()


def _one_trial(
    context: RunContext, devices: Devices, plan: Plan, controller: type[Controller], stage: ExecuteStage, trial: int
) -> TrialResult:
    law = stage.law(controller.name)
    name = f"{plan.name}-{controller.name}-{trial}"
    begin = TrialRecord(devices.clock.now_ns(), name, plan.skill, controller.name)
    context.write(begin)
    waypoints: list[WaypointRecord] = []
    laws: list[Controller] = []

    def made(anchored: Plan) -> Controller:
        given: dict[str, Any] = {"task": context.tasks[plan.name]} if controller.needs_task else {}
        laws.append(controller(anchored, settings=law, **given))
        return laws[-1]

    def tell(level: str, text: str) -> None:
        context.event(level, f"{name}: {text}")

    faults = Injector(stage.faults, devices.simulation, len(plan.ee), partial(tell, "warning"))

    with context.progress.steps(f"{controller.name} {trial + 1}", len(plan.ee)) as advance:

        def on_waypoint(record: WaypointRecord) -> None:
            witnessed = replace(record, truth=_truth(devices))
            waypoints.append(witnessed)
            context.write(witnessed)
            advance()
            faults.waypoint(record.step)

        def on_phase(phase: str, fraction: float) -> None:
            context.write(PhaseRecord(devices.clock.now_ns(), name, phase))
            if (phase, fraction) == ("trajectory", 0.0):
                let_go(devices, plan)
            if fraction in (0.0, 1.0):
                faults.phase(phase)

        watch = Watch(
            waypoint=on_waypoint,
            tick=context.heed,
            phase=on_phase,
            event=tell,
            felt=devices.tell_wrench,
            reset_scene=context.ask if devices.simulation is None else lambda _what: False,
        )
        clock, load = devices.clock, setup.free_air_load(context.resolved)
        # without a pose in the plan the extrinsic object is not on the table
        there = context.resolved if plan.eo is not None else replace(context.resolved, extrinsic=None)
        try:
            faults.begin()
            arrange(context, devices, plan, trial)
            fingers = context.fingers() if controller.feedback else ()  # nobody else asks where the go is
            observer = setup.observer(there, devices, context.settings, context.believed, fingers)
            looks.note(context, observer, name, extrinsic=there.extrinsic is not None)
            result = Trial(name, plan, made, observer, clock, load, context.settings, watch).run()
        except SimulationDiverged as error:
            result = TrialResult("diverged", str(error), plan)
        except DriverError as error:  # before the protocol began
            result = TrialResult("device_failed", str(error), plan)
    row = _row(context, name, controller, trial, result, waypoints)
    if laws and (told := laws[-1].told()) is not None:
        row["law"] = told
    end = replace(begin, status=result.status, reason=result.reason, plan=json.dumps(result.plan.to_dict()))
    with suppress(DriverError):  # a log that has failed ends the run after this
        context.write(replace(end, capture_ns=context.now_ns()))
    context.trial_done(row, finished=result.status not in CUT_OFF)
    return result


def _truth(devices: Devices) -> PlanarState | None:
    if devices.simulation is None:
        return None
    truth = devices.simulation.truth()
    return PlanarState(truth.ee, truth.go, truth.eo, truth.wrench)


def _row(
    context: RunContext,
    name: str,
    controller: type[Controller],
    trial: int,
    result: TrialResult,
    waypoints: list[WaypointRecord],
) -> dict[str, Any]:
    grasped, extrinsic = context.resolved.grasped, context.resolved.extrinsic if result.plan.eo is not None else None
    rho_go = grasped.polygon.radius_of_gyration
    rho_eo = None if extrinsic is None else extrinsic.polygon.radius_of_gyration
    found = result.deviation
    return {
        "name": name,
        "skill": result.plan.skill,
        "planner": result.plan.planner,
        "controller": controller.name,
        "go_pose": setup.go_pose(context.resolved, context.calibrations) if controller.feedback else None,
        "grasped_object": grasped.name,
        "extrinsic_object": None if extrinsic is None else extrinsic.name,
        "sensor": context.resolved.sensor.name,
        "trial": trial,
        "status": result.status,
        "reason": result.reason,
        "deviation": found and {"step": found.step, "status": found.status, "reason": found.reason},
        **{witness: errors_of(waypoints, witness, rho_go, rho_eo, rho_go) for witness in ("measured", "truth")},
        "contact": contact_of(waypoints, result.plan, grasped.polygon),
        "witness": witness_of(result.witness),
        "finger_slip": finger_slip_of(result.drifts, result.finger_slip),
    }


def _lazily(module: str, name: str) -> Callable[[RunContext, Any], None]:
    """A stage that is imported when it runs: what it needs is heavy."""

    def run(context: RunContext, stage: Any) -> None:
        if context.resolved.experiment.rehearse:
            context.event("warning", f"{stage.stage} touches things: it is no part of a rehearsal")
            return
        getattr(import_module(module), name)(context, stage)

    return run


_CALIBRATIONS = ("force_torque", "elasticity", "friction", "camera", "clock")


def has_diverged(trials: list[dict[str, Any]]) -> bool:
    """Whether the simulated world has become nonsense in a trial."""
    return any(trial["status"] == "diverged" for trial in trials)


def skip_stages(context: RunContext, stages: Sequence[Stage]) -> None:
    """Note among the results which stages do not run any more, and why: how the last trial ended.

    What made the world diverge, a plan or a stiffness, would do so again.
    """
    last = [*context.results["trials"], *context.results.get("rehearsals", ())][-1]
    reason = f"{last['name']} ended as {last['status']}"
    for stage in stages:
        name = getattr(stage, "name", None) or getattr(stage, "plan", "")
        context.results["not_run"].append({"stage": stage.stage, "name": name, "reason": reason})
        context.event("warning", f"{f'{stage.stage} {name}'.strip()}: not run, for {reason}")


STAGES: dict[str, Callable[[RunContext, Any], None]] = {
    "plan": plan_stage,
    "execute": execute_stage,
    "faults": _lazily("experiments.faults.stage", "faults_stage"),
    **{f"calibrate_{name}": _lazily(f"experiments.calibrate.{name}", f"{name}_stage") for name in _CALIBRATIONS},
}
