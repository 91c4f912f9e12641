"""The dry run: what an experiment would do, and whether its tasks exist, without touching a device."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from math import inf
from pathlib import Path
from types import MappingProxyType
from typing import get_args

from control.approach import resting_eo as resting
from control.motion import PEAK
from drivers.config import ArmConfig, ForceTorqueConfig, TactileConfig, WorldConfig
from drivers.sim.mismatch import load_profile
from drivers.sim.preflight import coupling_of, refuse_impossible
from experiments import disk, in_reach, in_view
from experiments.calibrate.schema import CameraStage, FrictionStage
from experiments.calibrate.store import Calibrations, load
from experiments.faults.schema import FaultsStage
from experiments.files import Resolved
from experiments.files import load as load_experiment
from experiments.json_output import beside, put
from experiments.planning.files import plan_files
from experiments.planning.make import resting_eo, task, try_start
from experiments.planning.schema import PlanStage
from experiments.schema import ExecuteStage
from experiments.setup import Believed, believed, go_pose, has_fingers, scene
from mechanics.yaml_input import InputError, Problem, one_of
from planning.errors import InfeasiblePlan
from planning.plan import Plan
from planning.skills.base import SkillTask

#: the sensors that fingers can be
FINGERS = get_args(TactileConfig.model_fields["sensor"].annotation)


def main(experiment: str, station: str | None, sets: Sequence[str], json_file: Path | None) -> None:
    """Show what an experiment would do, and write it as JSON where that was asked for; faults of its files, too.

    Raises as `check`, once the JSON is written.
    """
    told: dict[str, object] = {"schema": 1, "experiment": experiment, "ok": False, "lines": [], "problems": []}
    try:
        resolved = load_experiment(experiment, station, sets)
        told |= {"experiment": resolved.experiment.name, "station": resolved.station.name}
        lines = check(resolved)
    except InputError as error:
        put(json_file, told | {"problems": [asdict(problem) for problem in error.problems]})
        raise
    except InfeasiblePlan as error:
        put(json_file, told | {"infeasible": str(error)})
        raise
    put(json_file, told | {"ok": True, "lines": lines})
    console = beside(json_file)
    for line in lines:
        console.print(line, soft_wrap=True, highlight=False)


def check(
    resolved: Resolved,
    calibrations: Calibrations | None = None,
    feasible: bool = True,
    own: Mapping[str, Path] = MappingProxyType({}),
) -> list[str]:
    """What would run, in lines for a person. Raises InputError, and InfeasiblePlan for a task that has no plan.

    ``calibrations`` are those that the run uses, by default what `experiments.calibrate.store.load` finds. Without
    ``feasible``, whether there is a plan is left to the plan stage, which leaves its answer in the run's folder.
    ``own`` as `experiments.planning.files.plan_files` has it.
    """
    calibrations = load(resolved) if calibrations is None else calibrations
    problems = _device_problems(resolved) + _scene_problems(resolved)
    if problems:
        raise InputError(problems)
    disk.require_store(resolved)
    known = believed(resolved, calibrations)
    made = tasks(resolved, known, feasible)
    plans = plan_files(resolved, own)
    problems = [
        problem
        for eo in {*map(resting_eo, made.values()), *map(_resting_of_plan, plans.values())} - {None}
        for problem in _scene_problems(resolved, eo)
    ]
    problems = problems or in_view.problems(resolved, known, made, plans)
    problems = problems or in_reach.problems(resolved, made, plans)
    if problems:
        raise InputError(problems)
    experiment, station = resolved.experiment, resolved.station
    held = resolved.grasped
    lines = [
        f"experiment {experiment.name}, seed {experiment.seed}",
        f"station {station.name}: {', '.join(station.devices)}"
        + (f"; world {station.world.profile}, {station.world.clock}" if station.world else ""),
        f"sensor {resolved.sensor.name}; grasped object {held.name}, {held.mass:g} kg"
        + (
            f"; extrinsic object {resolved.extrinsic.name}, {resolved.extrinsic.mass:g} kg"
            if resolved.extrinsic
            else ""
        ),
        "friction " + ", ".join(f"{pair} {mu:g}" for pair, mu in resolved.friction.items()),
        "calibration " + (", ".join(str(file) for file in calibrations.files.values()) or "none: nominal figures"),
        f"controllers learn {held.name}'s pose {_source_of_pose(resolved, calibrations)}",
    ]
    trials = 0
    for number, stage in enumerate(experiment.stages, 1):
        if isinstance(stage, PlanStage):
            how = f"{stage.optimiser['name']} on {stage.backend}, {stage.form} form"
            count = made[stage.name].steps if stage.name in made else 0
            steps = f", {count} step{'s' if count > 1 else ''}" if count else ""
            lines.append(f"stage {number}: plan {stage.name}: {stage.skill}{steps}, {how}")
        elif isinstance(stage, ExecuteStage):
            trials += stage.trials * len(stage.controllers)
            count = f"{stage.trials} trial{'s' if stage.trials > 1 else ''} each"
            lines.append(f"stage {number}: execute {stage.plan}: {', '.join(stage.controllers)}, {count}")
        elif isinstance(stage, FaultsStage):
            trials += stage.count
            lines.append(f"stage {number}: faults in {stage.plan}: {stage.controller}, {stage.count} cells")
        else:
            pair = f" of {stage.pair}" if isinstance(stage, FrictionStage) else ""
            lines.append(f"stage {number}: {stage.stage.replace('_', ' ')}{pair}")
    lines.append(f"{trials} trial{'' if trials == 1 else 's'} in all; nothing was started")
    return lines


def _source_of_pose(resolved: Resolved, calibrations: Calibrations) -> str:
    """Where controllers learn the grasped object's pose from, in words, and why."""
    asked, found = resolved.experiment.trial.go_pose, go_pose(resolved, calibrations)
    if asked != "auto":
        return "from the fingers, as asked" if found == "tactile" else "from its tag, as asked"
    if found == "tactile":
        return "from the fingers: their elasticity with it is identified"
    if not has_fingers(resolved):
        return "from its tag: the station has no tactile fingers"
    stages = [stage.stage for stage in resolved.experiment.stages]
    if "calibrate_elasticity" in stages:
        return f"from its tag, and from the fingers after stage {stages.index('calibrate_elasticity') + 1}"
    return "from its tag: the fingers' elasticity with it is not identified"


def tasks(resolved: Resolved, known: Believed, feasible: bool = True) -> dict[str, SkillTask]:
    """The planning task of each plan stage by name; with ``feasible`` its forces exist.

    Raises InputError at the parameter that the geometry does not allow, and, with ``feasible``, InfeasiblePlan;
    without, the stages that the statics refuse are left out.
    """
    from planning import planner

    made: dict[str, SkillTask] = {}
    for i, stage in enumerate(resolved.experiment.stages):
        if not isinstance(stage, PlanStage):
            continue
        try:
            asked = task(resolved, stage, known)
            if feasible:
                planner.check(asked)
            made[stage.name] = asked
            _check_start(resolved, i, stage, asked)
        except ValueError as e:
            raise InputError([_task_problem(resolved, i, stage, str(e))]) from None
        except InfeasiblePlan:
            if feasible:
                raise
    return made


def _check_start(resolved: Resolved, i: int, stage: PlanStage, asked: SkillTask) -> None:
    """Raise InputError where the optimiser has no start; NoStart where the nominal trajectory is none either."""
    from experiments.planning.start import NoStart
    from planning import evaluation

    try:
        try_start(resolved, stage, asked)
    except NoStart as error:
        if evaluation.refusal(asked.problem, asked.problem.start) is not None:
            raise
        key, expected = ("stages", i, "start", "sigma"), "an error, in mm and N, that leaves the motion possible"
        raise InputError([resolved.experiment_document.problem(key, str(error), expected)]) from None


def _resting_of_plan(plan: Plan) -> tuple[float, float, float] | None:
    eo = resting(plan)
    return None if eo is None else (float(eo[0]), float(eo[1]), float(eo[2]))


def _task_problem(resolved: Resolved, i: int, stage: PlanStage, text: str) -> Problem:
    """The skill's complaint, at the parameter that it names first (``angle_deg: …``)."""
    parameter, colon, rest = text.partition(": ")
    path = ("stages", i, "parameters")
    if colon and parameter in stage.parameters:
        path, text = (*path, parameter), rest
    moved = "" if resolved.extrinsic is None else f" and {resolved.extrinsic.name}"
    expected = f"parameters that {stage.skill} can do with {resolved.grasped.name}{moved}"
    return resolved.experiment_document.problem(path, text, expected)


def _device_problems(resolved: Resolved) -> list[Problem]:
    """A run commands an arm, sees through a wrist force/torque sensor and a camera, and its sensor is its fingers'."""
    station, document = resolved.station, resolved.station_document
    problems = [
        document.problem(("devices",), f"the station has no {kind}", "a device of that kind")
        for kind in ("arm", "tag_camera")
        if not any(device.kind == kind for device in station.devices.values())
    ]
    if not any(isinstance(d, ForceTorqueConfig) and d.mount == "wrist" for d in station.devices.values()):
        problems.append(document.problem(("devices",), "the station has no force_torque on the wrist", "mount: wrist"))
    under = any(isinstance(d, ForceTorqueConfig) and d.mount == "table" for d in station.devices.values())
    for i, stage in enumerate(resolved.experiment.stages):
        if isinstance(stage, FrictionStage | CameraStage) and not under:
            wrong = "the station has no force_torque under the table, which feels what touches it"
            problems.append(resolved.experiment_document.problem(("stages", i), wrong, "a device with mount: table"))
    fingers = {name: device.sensor for name, device in station.devices.items() if isinstance(device, TactileConfig)}
    named = resolved.sensor.name  # a sensor of one's own may have any name but another finger's
    if named in FINGERS and (others := [f"{name} is a {kind}" for name, kind in fingers.items() if kind != named]):
        wrong = f"{named} is not what the station {station.name} holds with: {', '.join(others)}"
        expected = f"{one_of(set(fingers.values()))}, or a station with {named} fingers"
        problems.append(resolved.experiment_document.problem(("sensor",), wrong, expected))
    trial = resolved.experiment.trial
    fastest = PEAK * max(trial.approach_speed, trial.touch_speed) * trial.speed
    for arm in station.devices.values():
        if isinstance(arm, ArmConfig) and fastest > arm.limits.speed:
            wrong = f"{trial.approach_speed:g} m/s on the mean is {fastest:.3g} m/s in the middle of a motion"
            limit = arm.limits.speed
            expected = f"at most {limit / PEAK / trial.speed:.3g} m/s: the arm's limits.speed is {limit:g} m/s"
            problems.append(resolved.experiment_document.problem(("trial", "approach_speed"), wrong, expected))
    if not station.table_tags:
        problems.append(document.problem(("table_tags",), "the table has no tags", "at least one tag"))
    if not resolved.grasped.all_tags:
        wrong = f"{resolved.grasped.name} has no tag: the camera could not see it"
        problems.append(resolved.experiment_document.problem(("grasped_object",), wrong, "an object with a `tag`"))
    return problems


#: where a person sets what the scene has under each key, and what is expected there
_SCENE_KEYS = {
    "scene.stiffness": (("sensor",), "a sensor stiff enough for this object, or a grasp nearer to its vertices"),
    "scene.friction": (("friction",), "a coefficient above 0 for each pair that can touch"),
    "scene.extrinsic_pose": (("extrinsic_object",), "a pose in the world, clear of the ground"),
    "scene.start": (("grasped_object",), "bodies that are clear of each other at the start"),
}


def _scene_problems(resolved: Resolved, X_W_eo: tuple[float, float, float] | None = None) -> list[Problem]:
    """What the simulated world would refuse when the run has already begun. Raises InputError for the profile.

    With the extrinsic object at ``X_W_eo``, or with an empty table.
    """
    world = resolved.station.world or WorldConfig()
    profile = load_profile(world.profile)
    limit = (profile.fingers.force_limit or inf, profile.fingers.torque_limit or inf)
    try:
        begin = scene(resolved, X_W_eo)
        refuse_impossible(begin, coupling_of(begin, world.stiffness_scale, profile.membrane, limit))
    except ValueError as e:
        key, _, text = str(e).partition(": ")
        if key == "scene.finger_limit":
            expected = "a profile whose fingers hold this object"
            return [resolved.station_document.problem(("world", "profile"), text, expected)]
        if key not in _SCENE_KEYS:
            raise
        path, expected = _SCENE_KEYS[key]
        return [resolved.experiment_document.problem(path, text, expected)]
    return []
