"""What an arm's gates would refuse in a trial is bad input: it is told before anything runs. Held against the gates."""

import re
from types import SimpleNamespace
from typing import Any, cast

import pytest

from control.motion import Mover
from drivers.config import ArmConfig, ArmLimits
from drivers.errors import CommandRefused
from drivers.gates import Gates
from experiments.calibrate.store import Calibrations
from experiments.check import check, tasks
from experiments.files import load
from experiments.planned_poses import executed
from experiments.setup import believed
from experiments.shipped import experiments as shipped_experiments
from mechanics import se2
from mechanics.yaml_input import InputError

WIDE = ("stages.0.parameters.angle_deg=[5,60]", "stages.0.parameters.steps=5")


def resolved(*sets, experiment="grasped_pivoting"):
    return load(experiment, None, ["calibration.source=none", *sets])


def refusal(*sets):
    with pytest.raises(InputError) as refused:
        check(resolved(*sets), Calibrations())
    [problem] = refused.value.problems
    return problem


def driven(*sets) -> str:
    """What the gates say where a mover goes through the waypoints, in a clock that stands for no time at all."""
    experiment = resolved(*sets)
    made = tasks(experiment, believed(experiment, Calibrations()))
    [poses] = executed(experiment, made, {}).values()
    [limits] = [d.limits for d in experiment.station.devices.values() if isinstance(d, ArmConfig)]
    ee, settings = se2.compose(poses.go[1:], experiment.grasp), experiment.experiment.trial
    gates, now = Gates("arm", ArmLimits(**limits.model_dump()), {}, 0.0), [0]
    gates.restart(0, ee[0])
    gates.begin()

    def command(target):
        gates.admit(target, now[0], now[0])
        gates.accept(target, now[0])

    def sleep(seconds):
        now[0] += round(seconds * 1e9)

    clock = SimpleNamespace(now_ns=lambda: now[0], sleep=sleep, lockstep=True)
    mover = Mover.of(cast("Any", SimpleNamespace(command=command)), cast("Any", clock), ee[0], settings)
    try:
        for pose in ee[1:]:
            mover.ramp(pose, settings.ramp)
            mover.rest(0.1)
    except CommandRefused as refused:
        return str(refused)
    return ""


def test_a_plan_whose_waypoints_are_too_far_apart_is_told_before_it_starts():
    problem = refusal(*WIDE)
    assert problem.key == "trial.ramp"
    assert re.search(
        r"plan pivot has arm move at 0\.\d+ m/s, above its limit of 0\.25 m/s on the way from waypoint", problem.wrong
    )
    assert driven(*WIDE) != "", "the gates would have refused it"


@pytest.mark.parametrize("steps", [2, 3, 5])
def test_the_time_that_it_asks_for_is_one_that_the_gates_let_pass(steps):
    sets = (WIDE[0], f"stages.0.parameters.steps={steps}")
    least = re.search(r"at least ([\d.]+) s", refusal(*sets).expected)
    assert least is not None
    enough, short = (f"trial.ramp={share * float(least[1])}" for share in (1.02, 0.9))
    assert driven(*sets, enough) == ""
    assert driven(*sets, short) != ""
    check(resolved(*sets, enough), Calibrations())


def test_more_waypoints_will_do_and_so_will_a_slower_pace():
    slower = ("trial.speed=0.5",)
    for sets in ((WIDE[0], "stages.0.parameters.steps=20"), (*WIDE, *slower)):
        check(resolved(*sets), Calibrations())
        assert driven(*sets) == ""


@pytest.mark.parametrize(
    ("limit", "said"),
    [
        ("x=[0.1,0.4]", r"x = -?[\d.]+ m \(its limits are 0.1 to 0.4 m\)"),
        ("y=[0,0.1]", r"y = [\d.]+ m \(its limits are 0 to 0.1 m\)"),
        ("angle_deg=[-5,5]", r"an angle = [\d.]+ deg \(its limits are -5 to 5 deg\)"),
    ],
)
def test_a_plan_that_leaves_the_workspace_is_told_before_it_starts(limit, said):
    problem = refusal(f"devices.arm.limits.{limit}")
    assert re.search(f"plan pivot takes arm to {said} (before it touches|at waypoint \\d+)", problem.wrong)
    assert "devices.arm.limits" in problem.expected


@pytest.mark.parametrize(
    ("limit", "said"),
    [
        ("speed=0.02", "m/s"),
        ("turn_speed_deg=5", "turn at"),
        ("acceleration=0.1", "speed up by"),
        ("turn_acceleration_deg=20", "speed up its turn"),
    ],
)
def test_each_limit_of_motion_is_held(limit, said):
    sets = (f"devices.arm.limits.{limit}", "trial.approach_speed=0.01")
    problem = refusal(*sets)
    assert said in problem.wrong
    assert driven(*sets) != ""


def test_a_rehearsal_is_not_held_to_the_height_at_which_it_would_touch():
    check(resolved("devices.arm.limits.y=[0.16,0.6]", "rehearse=true"), Calibrations())


@pytest.mark.parametrize("name", [n for n in shipped_experiments() if n not in ("calibrate", "demo", "faults")])
def test_no_shipped_experiment_is_refused(name):
    check(resolved(experiment=name), Calibrations())


def test_one_waypoint_has_no_way_between():
    lines = check(resolved("stages.0.parameters.steps=1", "stages.0.parameters.angle_deg=[10,10]"), Calibrations())
    assert any("1 step" in line for line in lines)
