"""What laws are told of a grasp that is off: the observer on the simulated station in this process."""

from types import SimpleNamespace

import numpy as np
import pytest

from control.closed_loop import ClosedLoop
from control.observe import Finger
from estimation.force_torque import FreeAirLoad
from estimation.grasp_filter import GraspFilter
from estimation.state import StateEstimator
from estimation.tactile_pose import TactilePose
from mechanics import se2
from mechanics.elasticity import Elasticity
from tests.control.test_trial import Station
from tests.control.test_trial_witnesses import whole_observer

#: of 0.02 mm and 0.01 deg
GOOD = np.diag(np.array([2e-5, 2e-5, np.radians(0.01)]) ** -2)


def seeing(world):
    """A finger that sees where the object truly lies."""

    class Seeing:
        name = "truth"

        def estimate(self, image, prior):
            truth = world.truth()
            pose = se2.between(truth.ee, truth.go)
            return TactilePose(pose, np.linalg.inv(GOOD), GOOD, np.empty((0, 3)))

    now = SimpleNamespace(capture=lambda: SimpleNamespace(stamp=SimpleNamespace(capture_ns=world.now_ns())))
    return Finger(now, Seeing())  # pyright: ignore[reportArgumentType]


def test_the_wrench_that_laws_are_told_is_about_the_grasp_centre_that_plans_speak_of(tmp_path):
    # the object lies millimetres off in the fingers, and everything else is perfect
    lab = tmp_path / "off.yaml"
    lab.write_text("grasp: {offset: {xy_mm: [2.0, 1.5], angle_deg: 1}}")
    station = Station(f"world.profile={lab}")
    world = station.world
    world.regrasp(0)
    observer = station.observer()

    stiffness = station.plan.stiffness
    observer.fingers = (seeing(world),)
    observer.state = StateEstimator(
        GraspFilter(observer.grasp), Elasticity(stiffness), observer.wrist_sensor, FreeAirLoad(0.1, np.zeros(2))
    )
    assert station.run(ClosedLoop, observer=observer).status == "completed"
    told = [w.estimated for w in station.waypoints if w.estimated is not None]
    assert len(told) == len(station.waypoints)
    for estimated, waypoint in zip(told, station.waypoints, strict=True):
        assert estimated.wrench == pytest.approx(waypoint.measured.wrench, abs=1e-3)
    # where the fingers are is 2.5 mm from there, which makes up to 10 N mm of 4 N
    assert observer.felt is not None
    about_fingers = observer.felt.wrench[2] - told[-1].wrench[2]
    assert abs(about_fingers) > 4e-3


@pytest.mark.parametrize(("limit", "slips"), [(2.0, True), (20.0, False)])
def test_fingers_alone_tell_that_an_object_without_a_tag_slips_in_them(tmp_path, limit, slips):
    weak = tmp_path / "weak.yaml"
    weak.write_text(f"fingers: {{force_limit: {limit}, torque_limit: 1}}")
    station = Station(f"world.profile={weak}")
    observer, world = whole_observer(station), station.world
    observer.fingers = (seeing(world),)
    observer.tags["go"] = ()
    result = station.run(ClosedLoop, observer=observer, on_deviation="record")
    assert [waypoint.measured.go for waypoint in station.waypoints] == [None] * len(station.waypoints)
    assert bool(result.finger_slip) is slips
    drift = result.drifts[len(station.waypoints) - 1]
    assert drift.size_mm == pytest.approx(world.plant().finger_slip * 1e3, rel=0.1, abs=0.01)
