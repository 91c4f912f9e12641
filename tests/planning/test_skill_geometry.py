"""Outlines and touches: where faces are, and how far a go may turn about its contact before bodies meet elsewhere."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from shapely import affinity

from mechanics.catalogue import load_object
from planning.problem import Touch
from planning.skills import outline, touch

SHAPES = ("tall_box", "hbox", "z", "heptagon", "pentagon", "triangle")
GO = load_object("tall_box").polygon.vertices
SQUARE = np.array([[-0.05, -0.05], [0.05, -0.05], [0.05, 0.05], [-0.05, 0.05]])


def overlap(go, eo, meeting, angle):
    """Area [mm²] that both bodies cover when the go is at this relative angle."""
    turned = affinity.rotate(shapely.Polygon(go - meeting.p_go), angle, origin=(0, 0), use_radians=True)
    return turned.intersection(shapely.Polygon(eo - meeting.p_eo)).area * 1e6


def on_top(eo, x, tilt):
    """The go's corner on the eo's upper face at ``x`` [m]."""
    face = outline.facing(eo, np.array([0.0, 1.0]))
    place = outline.nearest(eo, (x * 1e3, float(eo[face, 1]) * 1e3), "contact_mm", "the eo")
    return touch.corner_on_face(GO, place, math.radians(tilt))


def test_a_box_on_a_wide_face_turns_from_its_lower_to_its_left_face():
    met = on_top(SQUARE * [4, 1], 0.0, 20.0)
    np.testing.assert_allclose(np.degrees(touch.room(GO, SQUARE * [4, 1], met)), [0, 90], atol=1e-9)


def test_a_corner_of_the_other_body_stops_a_turn_where_the_face_has_ended():
    """The go's corner is 10 mm from the end of the face: its lower face, 50 mm long, still lies flush on that."""
    met = on_top(SQUARE, 0.04, 20.0)
    np.testing.assert_allclose(np.degrees(touch.room(GO, SQUARE, met)), [0, 90], atol=1e-9)


def test_a_wall_beside_the_contact_stops_a_turn():
    """In a corner of 90°, 20 mm from the wall, the go's upright side meets the wall's top before it lies down."""
    ell = np.array([[-0.06, -0.03], [0.06, -0.03], [0.06, 0.0], [-0.02, 0.0], [-0.02, 0.05], [-0.06, 0.05]])
    place = outline.nearest(ell, (0.0, 0.0), "contact_mm", "the eo")
    met = touch.corner_on_face(GO, place, math.radians(10))
    least, most = np.degrees(touch.room(GO, ell, met))
    # the wall's upper end is 20 mm to the left and 50 mm up: the left side, tilted by atan(20/50), meets it
    assert math.isclose(most, math.degrees(math.atan2(20, 50)), rel_tol=1e-9)
    assert math.isclose(least, 0, abs_tol=1e-9)


def test_a_face_on_a_corner_turns_until_it_lies_on_either_face():
    mine = outline.on_face(GO, outline.facing(GO, np.array([0.0, -1.0])))
    met = touch.face_on_corner(SQUARE, 3, mine, 0.0)
    assert math.isclose(met.angle, math.radians(45))
    np.testing.assert_allclose(np.degrees(touch.room(GO, SQUARE, met)), [0, 90], atol=1e-9)
    np.testing.assert_allclose(met.into_eo, [math.sqrt(0.5), -math.sqrt(0.5)])


@settings(max_examples=60)
@given(
    st.sampled_from(SHAPES),
    st.integers(0, 7),
    st.floats(0.1, 0.9),
    st.floats(-80, 80),
    st.sampled_from(Touch),
)
def test_within_its_room_a_go_overlaps_nothing_and_at_the_ends_it_begins_to(shape, face, share, tilt, kind):
    """shapely measures the overlap at angles inside, at and beyond what the closed form says."""
    eo = outline.straightened(load_object(shape).polygon.vertices)
    face %= len(eo)
    try:
        if kind is Touch.CORNER_ON_FACE:
            met = touch.corner_on_face(GO, outline.on_face(eo, face, share), math.radians(tilt))
        else:
            assume(outline.is_convex_corner(eo, face))
            met = touch.face_on_corner(eo, face, outline.on_face(GO, 0, share), math.radians(tilt / 4))
        least, most = touch.room(GO, eo, met)
    except ValueError:
        assume(False)
    assert least < met.angle < most
    for angle in np.linspace(least, most, 25)[1:-1]:
        assert overlap(GO, eo, met, angle) < 1e-3
    step = math.radians(1.0)
    assert overlap(GO, eo, met, least - step) > 0
    assert overlap(GO, eo, met, most + step) > 0


@given(st.floats(-70, 70), st.floats(0, 0.15))
def test_room_above_the_ground_ends_where_a_corner_touches_it(tilt, height):
    corner = GO[1]
    theta = math.radians(tilt)

    def lowest(angle):
        c, s = math.cos(angle), math.sin(angle)
        arms = GO - corner
        return height + float((s * arms[:, 0] + c * arms[:, 1]).min())

    assume(lowest(theta) > 1e-4)
    least, most = touch.room_above_ground(GO, corner, height, theta)
    for angle in np.linspace(least, most, 15)[1:-1]:
        assert lowest(angle) > -1e-9
    if most - least < 2 * math.pi - 1e-9:
        assert math.isclose(lowest(least), 0, abs_tol=1e-9)
        assert math.isclose(lowest(most), 0, abs_tol=1e-9)


def test_a_go_below_the_ground_is_refused_in_millimetres():
    with pytest.raises(ValueError, match=r"tilt_deg: .* a corner is 7\.1 mm below it"):
        # the other lower corner, 50 mm to the side, at −45°: 35.36 mm below a contact at 28.26 mm
        touch.room_above_ground(GO, GO[1], 0.02826, math.radians(45))


def test_the_face_that_looks_up_and_the_one_that_looks_left():
    z = load_object("z").polygon.vertices
    top = outline.on_face(z, outline.facing(z, np.array([0.0, 1.0])))
    np.testing.assert_allclose(top.point * 1e3, [17.25, 63.4])  # the flange, above the foot
    left = outline.on_face(z, outline.facing(z, np.array([-1.0, 0.0])))
    np.testing.assert_allclose(left.point * 1e3, [-51.8, -46.1])  # the foot, left of the bar


def test_along_a_face_before_and_after_reach_its_ends():
    place = outline.nearest(SQUARE, (10.0, 50.0), "contact_mm", "the eo")
    np.testing.assert_allclose(place.point, [0.01, 0.05])
    np.testing.assert_allclose(place.normal, [0, 1])
    # e of an upper face leads to the right: 40 mm on, 60 mm back
    np.testing.assert_allclose([place.before, place.after], [0.06, 0.04])


def test_a_vertex_in_the_middle_of_a_face_is_no_corner():
    with_middle = np.insert(SQUARE, 1, [0.0, -0.05], axis=0)
    np.testing.assert_array_equal(outline.straightened(with_middle), SQUARE)
    np.testing.assert_array_equal(outline.straightened(with_middle[::-1]), SQUARE)
