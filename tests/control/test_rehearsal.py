"""The rehearsal on the simulated station in this process: the trial's motion, with nothing in its way."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from control.rehearsal import Rehearsal, RehearsalResult
from control.settings import TrialSettings
from control.trial import Watch
from estimation.force_torque import FreeAirLoad

from .test_trial import Station

LIFT = 0.08


def rehearse(station: Station, lift: float = LIFT, **settings: Any) -> RehearsalResult:
    watch = Watch(phase=lambda name, _: station.phases.append(name), tick=station.tick)
    load, chosen = FreeAirLoad(0.1, np.zeros(2)), TrialSettings(**settings)
    return Rehearsal(station.plan, lift, station.observer(), station.world, load, chosen, watch).run()


class Watched(Station):
    """Notes where the arm is, at each set-point."""

    def __init__(self) -> None:
        super().__init__()
        self.poses: list[Any] = []
        self.touched = False

    def tick(self) -> None:
        self.poses.append(np.array(self.arm.pose))
        self.touched |= bool(self.world.truth().contacts)


def test_the_arm_goes_through_every_pose_of_the_plan_lifted_and_touches_nothing() -> None:
    station = Watched()
    result = rehearse(station)
    assert (result.status, result.reason) == ("completed", "")
    assert list(dict.fromkeys(station.phases)) == ["approach", "preload", "trajectory", "unload", "done"]
    for ee in (*station.plan.preload_ee, *station.plan.ee, *station.plan.unload_ee):
        nearest = np.abs(np.array(station.poses) - (ee + np.array([0.0, LIFT, 0.0]))).max(axis=1).min()
        assert nearest < 5e-4
    assert not station.touched
    assert result.force < 0.5


def test_whatever_is_in_the_way_ends_it() -> None:
    station = Watched()
    result = rehearse(station, lift=0.0)  # at the height of the table itself
    assert result.status == "stopped"
    assert "act on the grasped object, where it should touch nothing" in result.reason
    assert 3.0 < result.force < 30.0


def test_at_a_fifth_of_its_speed_it_is_the_same_motion() -> None:
    station, slow = Watched(), Watched()
    usual, slowly = rehearse(station), rehearse(slow, speed=0.2)
    assert slowly.status == "completed"
    assert 4.0 * usual.seconds < slowly.seconds < 5.0 * usual.seconds
    assert slow.poses[-1] == pytest.approx(station.poses[-1], abs=1e-9)
