"""What a trial does about a contact that deviates: it asks the law, and ends or goes on and keeps it on record."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from control.closed_loop import ClosedLoop
from control.open_loop import OpenLoop
from estimation.tag_pose import TagPose
from experiments import setup
from mechanics.friction import Mode

from .test_trial import STEPS, Station


class Slippery(Station):
    """A ground of µ = 0.05 under a plan that presses with 4 N and pulls sideways with up to 1.2 N more and more."""

    def __init__(self, *sets):
        super().__init__("stages.0.parameters.tangential=[0, 1.2]", "stages.0.parameters.force=4", *sets)
        self.devices["gripper"].release()
        scene = setup.scene(self.resolved)
        self.world.reset(0, scene.model_copy(update={"friction": {"go-ground": 0.05}}))
        self.world.advance(0.2)

    def corner(self, waypoint) -> float:
        """Where along the ground [m] the corner is seen at a waypoint."""
        go, planned = waypoint.measured.go, waypoint.planned.go
        corner = self.plan.contact_points[waypoint.step, 0] - planned[:2]
        turn = go[2] - planned[2]
        return float(go[0] + np.cos(turn) * corner[0] - np.sin(turn) * corner[1])


class Lifting(OpenLoop):
    """Takes the go off the ground at the second waypoint, and puts it back at the third."""

    def waypoint(self, step):
        return super().waypoint(step) + np.array([0.0, 0.02 if step == 1 else 0.0, 0.0])


class Replanning(OpenLoop):
    """Takes in what it is asked about, as often as it ``can``."""

    can = 99

    def __init__(self, plan, settings=None):
        super().__init__(plan, settings)
        self.asked = []

    def replan(self, step, measured, deviation):
        self.asked.append((step, measured, deviation))
        return len(self.asked) <= self.can


def made(law, kept):
    """The law, kept in ``kept`` as the trial makes it."""
    return lambda plan: kept.setdefault("law", law(plan))


def test_a_slip_ends_the_trial_with_the_contact_and_the_way_and_off_the_ground():
    station = Slippery()
    result = station.run(slip_tolerance_mm=0.3)
    assert result.status == "slipped"
    slip = (station.corner(station.waypoints[-1]) - station.corner(station.waypoints[0])) * 1e3
    assert slip < -0.3  # the ground is to push to the right: the fingers pull to the left
    assert f"contact 'corner' has slipped by {-slip:.1f} mm (slip+)" in result.reason
    assert result.deviation is not None and result.deviation.step == station.waypoints[-1].step
    assert result.deviation.slip == pytest.approx(-slip * 1e-3, abs=1e-5)
    assert station.phases[-1] == "retreat"
    assert station.world.truth().contacts == ()


def test_a_recorded_slip_lets_the_trial_go_on_and_is_its_status():
    station = Slippery()
    result = station.run(slip_tolerance_mm=0.3, on_deviation="record")
    assert [waypoint.step for waypoint in station.waypoints] == list(range(STEPS))
    assert station.phases[-1] == "done"
    assert result.status == "slipped" and result.deviation is not None
    assert result.reason == result.deviation.reason and f"waypoint {result.deviation.step}" in result.reason
    assert [level for level, text in station.events if "the trial goes on" in text] == ["warning"]


def test_the_first_of_several_deviations_is_the_one_on_record():
    # it leaves the ground, and once it is back it stands elsewhere
    station = Slippery()
    result = station.run(Lifting, on_deviation="record", slip_tolerance_mm=0.3)
    assert len(station.waypoints) == STEPS
    assert result.status == "lost_contact" and "waypoint 1" in result.reason


def test_a_lost_contact_ends_a_trial_by_default():
    station = Station()
    result = station.run(Lifting)
    assert result.status == "lost_contact" and len(station.waypoints) == 2


def test_a_force_beyond_the_limit_ends_a_trial_that_records():
    station = Station()
    result = station.run(force_limit=2.0, on_deviation="record")
    assert result.status == "stopped" and len(station.waypoints) == 1


def test_a_law_that_takes_a_slip_in_goes_on_and_is_asked_about_the_next():
    station, kept = Slippery("stages.0.parameters.steps=5"), {}
    result = station.run(made(Replanning, kept), slip_tolerance_mm=0.1)
    assert result.status == "completed" and result.deviation is None
    asked = kept["law"].asked
    assert len(asked) >= 2
    for step, measured, deviation in asked:
        assert deviation.step == step and deviation.contact == "corner"
        np.testing.assert_array_equal(measured.go, station.waypoints[step].measured.go)
    # the second slip is told from where the first was taken in
    steps = [step for step, _, _ in asked]
    assert f"since waypoint {steps[0]}" in asked[1][2].reason
    assert [text for _, text in station.events if "taken it in" in text]


def test_a_law_that_cannot_go_on_any_more_ends_the_trial():
    station, kept = Slippery("stages.0.parameters.steps=5"), {}
    result = station.run(made(type("Once", (Replanning,), {"can": 1}), kept), slip_tolerance_mm=0.1)
    assert result.status == "slipped" and len(kept["law"].asked) == 2
    assert result.deviation is kept["law"].asked[1][2]


def test_a_law_is_not_asked_about_a_stop():
    station, kept = Station(), {}
    assert station.run(made(Replanning, kept), force_limit=2.0).status == "stopped"
    assert kept["law"].asked == []


def test_a_law_is_asked_about_a_slip_before_it_corrects_where_that_went():
    calls = []

    class Asked(ClosedLoop):
        def in_contact(self, step, measured):
            calls.append((step, "corrects"))

        def replan(self, step, measured, deviation):
            calls.append((step, "is asked"))
            return True

    result = Slippery("stages.0.parameters.steps=5").run(Asked, slip_tolerance_mm=0.1)
    assert result.status == "completed"
    asked = {step for step, what in calls if what == "is asked"}
    assert len(asked) >= 2
    assert calls == [(step, "is asked" if step in asked else "corrects") for step in range(5)]


def test_an_object_that_slides_while_it_is_loaded_ends_the_trial_at_the_first_waypoint():
    station = Station()
    resting = np.array([0.1, 0.03, 0.0])
    plan = replace(
        station.plan,
        eo=np.tile(resting, (STEPS, 1)),
        preload_eo=np.tile(resting, (len(station.plan.preload_go), 1)),
        unload_eo=np.tile(resting, (len(station.plan.unload_go), 1)),
        contact_bodies=(("eo", "ground"),),
        contact_points=np.tile([0.1, 0.0], (STEPS, 1, 1)),
    )
    station.plan = plan
    observer = station.observer()
    look, slid = observer._see, np.array([0.0, 0.0, 0.0])

    def see(bodies):
        found = look(tuple(body for body in bodies if body != "eo"))
        if "eo" in bodies:
            found["eo"] = TagPose(resting + slid, np.eye(3) * 1e-10, 0.1, 1)
        return found

    def slide():
        if station.phases[-1:] == ["preload"]:
            slid[0] = 0.004

    observer._see, station.tick = see, slide
    result = station.run(observer=observer)
    assert result.status == "slipped" and len(station.waypoints) == 1
    assert "contact 'corner' has slipped by 4.0 mm (slip-) since touch-down" in result.reason


# -- a go that nobody sees ---------------------------------------------------------------------------------------------


def test_a_go_without_a_tag_is_executed_unseen_and_says_so():
    station = Station()
    observer = station.observer()
    observer.tags["go"] = ()
    result = station.run(observer=observer)
    assert result.status == "completed", result.reason
    assert [waypoint.measured.go for waypoint in station.waypoints] == [None] * STEPS
    for waypoint in station.waypoints:
        assert waypoint.measured.wrench[:2] == pytest.approx(waypoint.planned.wrench[:2], abs=0.02)
    assert [text for level, text in station.events if level == "warning" and "no tag" in text]


def test_a_go_whose_tag_is_hidden_after_the_start_is_executed_by_its_wrench():
    station = Station()
    observer = station.observer()

    def hide():
        if station.phases[-1:] == ["preload"]:
            observer.tags["go"] = ()

    station.tick = hide
    result = station.run(ClosedLoop, observer=observer)
    assert result.status == "completed", result.reason
    assert [waypoint.measured.go for waypoint in station.waypoints] == [None] * STEPS
    for waypoint in station.waypoints:
        assert waypoint.measured.wrench[:2] == pytest.approx(waypoint.planned.wrench[:2], abs=0.05)


def test_a_go_without_a_tag_that_comes_off_the_ground_is_found_by_its_force():
    station = Station()
    observer = station.observer()
    observer.tags["go"] = ()
    assert station.run(Lifting, observer=observer).status == "lost_contact"


# -- updates at a waypoint ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("mode", "updates"), [(Mode.STICK, 2), (Mode.SLIP_NEGATIVE, 1)])
def test_where_a_contact_slips_the_law_updates_once_at_a_waypoint(mode, updates):
    station, steps = Station(), []
    station.plan = replace(station.plan, contact_modes=((mode,),) * STEPS)

    class Counting(ClosedLoop):
        def in_contact(self, step, measured):
            steps.append(step)

    assert station.run(Counting, corrections=2).status == "completed"
    assert steps == sorted([*range(STEPS)] * updates)


@pytest.mark.parametrize(("mode", "seen_at"), [(Mode.STICK, 0), (Mode.SLIP_NEGATIVE, 1)])
def test_where_a_contact_slips_an_update_is_first_seen_at_the_next_waypoint(mode, seen_at):
    station = Station()
    station.plan = replace(station.plan, contact_modes=((mode,),) * STEPS)
    told, lifted = [], np.array([0.0, 2e-4, 0.0])

    class Lifted(ClosedLoop):
        def in_contact(self, step, measured):
            told.append(measured)
            self.correction = lifted

        def in_air(self, go_desired, measured):
            pass

    assert station.run(Lifted).status == "completed"
    corrected = [
        np.abs(waypoint.commanded - station.plan.ee[waypoint.step]).max() > 1e-4 for waypoint in station.waypoints
    ]
    assert corrected == [step >= seen_at for step in range(STEPS)]
    if seen_at:  # made of what is recorded, to the bit
        assert [measured.wrench.tolist() for measured in told] == [
            w.measured.wrench.tolist() for w in station.waypoints
        ]
