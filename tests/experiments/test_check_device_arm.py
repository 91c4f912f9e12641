"""The bring-up of a robot and its hand, at one that speaks their protocol. Nothing moves unless it is asked for."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from drivers.emulators.franka_arm import FrankaArmEmulator
from drivers.real.arm_frames import ArmFrames, PlaneInBase, ToolMount
from experiments.check_device.findings import Verdict
from experiments.check_device.person import Nobody
from tests.experiments.check_devices import Hand, findings, station
from tests.experiments.check_devices import found as look

pytestmark = pytest.mark.alone

START = np.array([0.0, 0.25, 0.1])
#: how far a robot that stands still is off [m, rad]
STILL = 1e-3
# its rate is the emulator's, which a crowded machine slows down


@pytest.fixture(scope="module")
def robot() -> Iterator[FrankaArmEmulator]:
    with FrankaArmEmulator(ArmFrames(PlaneInBase(), ToolMount()), START, block=0.03) as emulated:
        yield emulated


def arm(robot, **more):
    franka = {"kind": "arm", "driver": "franka", "realtime": "ignore", "host": robot.host}
    return station("arm", franka | more)


def hand(robot):
    return station("gripper", {"kind": "gripper", "driver": "franka_hand", "host": robot.host})


def height(robot) -> float:
    return float(robot.pose()[1][1])


def test_an_arm_is_where_it_stands_and_does_not_move_unasked(robot):
    before = height(robot)
    found = findings(arm(robot), "arm", Nobody(agreed=True))
    well = {name for name, finding in found.items() if finding.verdict is Verdict.GOOD}
    assert well >= {"reach", "describe", "age", "values", "pose", "rest", "gates", "joints"}, found
    assert found["move"].verdict is Verdict.SKIPPED
    np.testing.assert_allclose(found["pose"].figures["pose"], robot.pose()[1], atol=STILL)
    assert abs(height(robot) - before) < STILL


def test_an_arm_does_not_move_for_who_does_not_agree(robot):
    before, person = height(robot), Hand(agrees=False)
    found = findings(arm(robot), "arm", person, move=True, only=("pose", "move"))
    assert found["move"].verdict is Verdict.SKIPPED
    assert any("THE ARM MOVES" in question for question in person.heard)
    assert found["pose"].verdict is Verdict.SHORT  # it is not where they see it
    assert abs(height(robot) - before) < STILL


def test_an_arm_moves_5_mm_and_stops_half_way_back_where_that_is_agreed(robot):
    before = height(robot)
    found = look("move", arm(robot), "arm", Nobody(agreed=True), move=True)
    assert found.verdict is Verdict.GOOD, found
    assert 0.0005 < height(robot) - before < 0.0035


def test_an_arm_at_the_end_of_its_limits_does_not_go_beyond(robot):
    before = height(robot)
    limits = {"y": [0.0, before + 0.002]}
    found = look("move", arm(robot, limits=limits), "arm", Nobody(agreed=True), move=True)
    assert found.verdict is Verdict.SHORT
    assert abs(height(robot) - before) < STILL


def test_an_arm_outside_its_limits_is_told(robot):
    found = look("pose", arm(robot, limits={"y": [0.5, 0.6]}), "arm")
    assert found.verdict is Verdict.SHORT
    assert "outside the limits" in found.measured


def test_a_hand_opens_and_closes_on_request_only(robot):
    left_out = look("cycle", hand(robot), "gripper", Nobody(agreed=True))
    assert left_out.verdict is Verdict.SKIPPED
    done = look("cycle", hand(robot), "gripper", Nobody(agreed=True), move=True)
    assert done.verdict is Verdict.GOOD, done
    assert "holding something" in done.measured  # the block between its fingers, 30 mm wide
    assert done.figures["closed_mm"] == pytest.approx(30, abs=1)
