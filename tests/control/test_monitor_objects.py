"""The contacts of two objects: which of them slips, opens or tips, and that the noise of tags is none of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from control.monitor import ContactMonitor, corner_and_face
from control.settings import TrialSettings
from mechanics import se2
from mechanics.friction import Mode
from mechanics.records import PlanarState

STEPS = 40
TOLERANCE = 0.001
#: half of a box of 120 × 60 mm
HALF = np.array([0.06, 0.03])


def objects(plan, go, eo, points, normals, bodies, names=("object", "ground left", "ground right")):
    """The plan of both poses (K, 3), with contacts (K, C, 2) that all stick."""
    K, M, N = len(go), len(plan.preload_go), len(plan.unload_go)
    C = len(names)
    return replace(
        plan,
        ee=go,
        go=go,
        eo=eo,
        wrench=np.tile([0.0, -3.0, 0.0], (K, 1)),
        preload_eo=np.tile(eo[0], (M, 1)),
        unload_eo=np.tile(eo[0], (N, 1)),
        contact_names=names,
        contact_bodies=bodies,
        contact_points=points,
        contact_normals=normals,
        contact_forces=np.tile([3.0, 0.0], (K, C, 1)),
        contact_modes=((Mode.STICK,) * C,) * K,
        contact_mu=np.full(C, 0.33),
    )


ON_TOP = (("eo", "go"), ("eo", "ground"), ("eo", "ground"))


@pytest.fixture
def turning(plan):
    """The go turns by 30 degrees about its corner, the origin of its frame, on top of a box that lies."""
    eo = np.tile([0.0, HALF[1], 0.0], (STEPS, 1))
    go = np.column_stack([np.zeros(STEPS), np.full(STEPS, 2 * HALF[1]), np.linspace(0.2, 0.72, STEPS)])
    points = np.tile([[0.0, 2 * HALF[1]], [-HALF[0], 0.0], [HALF[0], 0.0]], (STEPS, 1, 1))
    normals = np.tile([[0.0, -1.0], [0.0, 1.0], [0.0, 1.0]], (STEPS, 1, 1))
    return objects(plan, go, eo, points, normals, ON_TOP)


@pytest.fixture
def tipping(plan):
    """The go's corner pushes a box over its right vertex, which stays at the origin, by 25 degrees."""
    angle = np.linspace(0.0, -np.radians(25), STEPS)
    vertex, touched = np.array([HALF[0], -HALF[1]]), np.array([-HALF[0], 0.02])
    eo = np.column_stack([-se2.rotate(angle, vertex), angle])
    at = se2.transform(eo, touched)
    go = np.column_stack([at, 0.3 * angle])
    points = np.stack([at, np.zeros((STEPS, 2))], axis=1)
    normals = np.stack([se2.rotate(angle, np.array([1.0, 0.0])), np.tile([0.0, 1.0], (STEPS, 1))], axis=1)
    return objects(plan, go, eo, points, normals, ON_TOP[:2], ("object", "ground right"))


def watch(plan, go, eo, tolerance=TOLERANCE):
    """What the monitor says first of objects at ``go`` and ``eo`` (K, 3)."""
    monitor = ContactMonitor(plan, tolerance, 30.0)
    for k in range(len(go)):
        measured = PlanarState(plan.ee[k], go[k], eo[k], plan.wrench[k])
        found = monitor.check(k, measured, np.zeros(2))
        if found is not None:
            return found
    return None


def since(step, motion):
    """``motion`` (3,) that grows evenly from ``step`` to the end."""
    return np.clip(np.arange(STEPS) - step, 0, None)[:, None] / (STEPS - 1 - step) * np.asarray(motion)


def test_what_goes_as_planned_goes_on(turning, tipping):
    for plan in (turning, tipping):
        assert watch(plan, plan.go, plan.eo) is None


def test_the_go_that_slides_on_the_object_has_slipped_there(turning):
    # into the object acted on, which it pushes down: n = (0, -1), t = (-1, 0); the go to the right is along -t
    found = watch(turning, turning.go + since(10, [0.004, 0.0, 0.0]), turning.eo)
    assert found is not None and (found.status, found.contact) == ("slipped", "object")
    assert "(slip-)" in found.reason
    assert found.step == 10 + 8  # 4 mm in 29 steps: over 1 mm at the eighth


def test_two_objects_that_slide_together_have_slipped_on_the_ground(turning):
    together = since(10, [0.004, 0.0, 0.0])
    found = watch(turning, turning.go + together, turning.eo + together)
    assert found is not None and (found.status, found.contact) == ("slipped", "ground left")


def test_an_object_that_tips_opens_one_of_its_two_contacts_with_the_ground(turning):
    # about its right vertex, and the go stays on it
    over = since(0, [0.0, 0.0, -0.1])
    eo = np.column_stack([HALF[0] - se2.rotate(over[:, 2], HALF * [1, -1]), over[:, 2]])
    eo[:, 1] = -se2.rotate(over[:, 2], HALF * [1, -1])[:, 1]
    go = turning.go.copy()
    go[:, :2] = se2.transform(eo, np.array([0.0, HALF[1]]))
    found = watch(turning, go, eo)
    assert found is not None and (found.status, found.contact) == ("lost_contact", "ground left")
    # 120 mm wide: over 1 mm at 1/120 rad
    assert over[found.step, 2] < -1 / 120 < over[found.step - 1, 2]


def test_a_pivot_that_slides_has_slipped(tipping):
    sliding = since(0, [0.004, 0.0, 0.0])
    found = watch(tipping, tipping.go + sliding, tipping.eo + sliding)
    assert found is not None and (found.status, found.contact) == ("slipped", "ground right")
    assert found.slip is not None and found.slip == pytest.approx(-0.001, abs=1.1e-4)


def test_a_go_that_comes_off_the_object_has_lost_it(tipping):
    found = watch(tipping, tipping.go - since(0, [0.004, 0.0, 0.0]), tipping.eo)
    assert found is not None and (found.status, found.contact) == ("lost_contact", "object")


def test_the_body_with_the_face_is_told_from_the_one_with_the_corner(turning, tipping):
    assert corner_and_face(turning, 0) == corner_and_face(tipping, 0) == ("go", "eo")
    assert corner_and_face(turning, 1) == ("eo", "ground")
    # seen from the go, an object that turns about its own corner on the go's face
    upside_down = replace(turning, go=turning.eo, eo=turning.go, contact_normals=-turning.contact_normals)
    assert corner_and_face(upside_down, 0) == ("eo", "go")


def test_a_face_that_slides_over_a_corner_brings_the_face(turning):
    # the corner at rest is the eo's: neither turns, and the point travels in the go
    go = turning.go[:1] + since(0, [0.02, 0.0, 0.0])
    eo = np.tile(turning.eo[0], (STEPS, 1))
    assert corner_and_face(replace(turning, go=go, eo=eo), 0) == ("eo", "go")
    points = turning.contact_points + since(0, [0.02, 0.0, 0.0])[:, None, :2] * np.array([1, 0, 0])[:, None]
    assert corner_and_face(replace(turning, go=go, eo=eo, contact_points=points), 0) == ("go", "eo")


def test_a_go_that_landed_elsewhere_turns_about_where_it_landed(turning):
    # 4 mm along the top and turned by 2 degrees: about the planned place the turn would lift it by 2 mm
    go = turning.go + np.array([0.004, 0.0, 0.035])
    assert watch(turning, go, turning.eo) is None


@pytest.mark.parametrize("moving", ["turning", "tipping"])
def test_the_noise_of_tags_is_no_slip(moving, request):
    """1 sigma: 0.05 mm and 0.06 deg anew at each waypoint, 0.08 mm and 0.08 deg as the tag sits on its body."""
    plan = request.getfixturevalue(moving)
    rng = np.random.default_rng(6)
    white, bias = np.array([0.05e-3, 0.05e-3, np.radians(0.06)]), np.array([0.08e-3, 0.08e-3, np.radians(0.08)])
    # a tag on the go, its corner 118 mm away
    tag = np.array([0.0, 0.118, 0.0])
    tolerance = TrialSettings().slip_tolerance_mm * 1e-3

    def seen(poses, X_BT):
        off = bias * rng.standard_normal(3)
        true = se2.compose(se2.compose(poses, X_BT), off)
        return se2.compose(true + white * rng.standard_normal((STEPS, 3)), se2.inverse(X_BT))

    for _ in range(25):
        assert watch(plan, seen(plan.go, tag), seen(plan.eo, np.zeros(3)), tolerance) is None


# -- before the first waypoint -----------------------------------------------------------------------------------------


def before_touch(plan):
    monitor = ContactMonitor(plan, TOLERANCE, 30.0)
    monitor.before_touch(plan.preload_eo[0])
    return monitor


def measured(plan, slid=(0.0, 0.0, 0.0), step=0, wrench=None):
    """Both objects as planned at a waypoint, but moved together by ``slid`` (3,)."""
    off = np.array(slid)
    push = plan.wrench[step] if wrench is None else np.array(wrench)
    return PlanarState(plan.ee[step], plan.go[step] + off, plan.eo[step] + off, push)


def test_an_object_that_slid_in_the_preload_has_slipped_at_the_first_waypoint(tipping):
    found = before_touch(tipping).check(0, measured(tipping, [0.004, 0.0, 0.0]), np.zeros(2))
    assert found is not None and (found.status, found.contact, found.step) == ("slipped", "ground right", 0)
    assert found.reason == "waypoint 0: contact 'ground right' has slipped by 4.0 mm (slip-) since touch-down"


def test_an_object_that_slid_away_from_under_the_force_has_slipped_and_not_lost_its_contact(tipping):
    found = before_touch(tipping).check(0, measured(tipping, [0.02, 0.0, 0.0], wrench=[0.0, 0.0, 0.0]), np.zeros(2))
    assert found is not None and (found.status, found.contact) == ("slipped", "ground right")


def test_one_contact_that_slips_is_told_before_another_that_opens(tipping):
    gone = measured(tipping, [0.004, 0.0, 0.0])
    gone = replace(gone, go=gone.go - np.array([0.03, 0.0, 0.0]))
    found = before_touch(tipping).check(1, gone, np.zeros(2))
    assert found is not None and (found.status, found.contact) == ("slipped", "ground right")


def test_an_object_that_the_go_met_where_it_stood_goes_on(tipping, turning):
    for plan in (tipping, turning):
        monitor = before_touch(plan)
        for k in range(STEPS):
            assert monitor.check(k, measured(plan, step=k), np.zeros(2)) is None


def test_a_go_that_lands_elsewhere_on_an_object_that_stands_has_not_slipped(turning):
    elsewhere = measured(turning)
    elsewhere = replace(elsewhere, go=elsewhere.go + np.array([0.003, 0.0, 0.0]))
    assert before_touch(turning).check(0, elsewhere, np.zeros(2)) is None


def test_an_object_that_is_to_slide_may_be_pushed_along_by_the_preload(turning):
    modes = ((Mode.STICK, Mode.SLIP_NEGATIVE, Mode.SLIP_NEGATIVE),) * STEPS
    along = since(0, [0.02, 0.0, 0.0])
    pushed = replace(
        turning,
        go=turning.go + along,
        eo=turning.eo + along,
        contact_points=turning.contact_points + along[:, None, :2],
        contact_modes=modes,
    )
    monitor = before_touch(pushed)
    assert monitor.check(0, measured(pushed, [0.004, 0.0, 0.0]), np.zeros(2)) is None


def test_a_slip_is_seen_before_it_is_checked_and_nothing_is_marked_by_looking(tipping):
    monitor = ContactMonitor(tipping, TOLERANCE, 30.0)
    assert not monitor.has_slipped(0, measured(tipping, [0.004, 0.0, 0.0]))  # there are no marks yet
    assert monitor.check(0, measured(tipping), np.zeros(2)) is None  # and these are the first
    assert monitor.has_slipped(1, measured(tipping, [0.004, 0.0, 0.0], 1))
    assert not monitor.has_slipped(1, measured(tipping, [np.nan, 0.0, 0.0], 1))
    assert monitor.check(1, measured(tipping, step=1), np.zeros(2)) is None
