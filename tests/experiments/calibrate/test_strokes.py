"""Strokes that friction is found from: how they are drawn, and that what tells nothing is refused before it moves."""

from typing import Any

import numpy as np
import pytest

from estimation.errors import FitError
from experiments.calibrate.strokes import BIN, CLEARANCE, SWINGING, Dragged, Stroke, clear, drawn, steady, stroked
from mechanics import se2
from mechanics.catalogue import load_object, load_sensor

NOBODY: Any = None


@pytest.mark.parametrize(("length", "speed"), [(0.001, 0.02), (0.015, 0.2)])
def test_a_stroke_too_short_or_too_fast_to_move_evenly_is_refused(length: float, speed: float) -> None:
    stroke = Stroke(tilt=0.3, force=4.0, begin=-length / 2, end=length / 2)
    with pytest.raises(FitError, match="even motion"):
        stroked(NOBODY, NOBODY, stroke, speed)


def test_each_stroke_is_followed_by_its_like_to_the_other_side() -> None:
    strokes = drawn(np.random.default_rng(0), 7, (0.1, 0.3), (3.0, 6.0), 0.02)
    for there, back in zip(strokes[::2], strokes[1::2], strict=False):
        assert (back.tilt, back.force, back.begin, back.end) == (-there.tilt, there.force, -there.begin, -there.end)
    assert len({stroke.force for stroke in strokes}) == 4, "drawn anew for each pair"


def test_the_object_leans_back_from_where_it_goes() -> None:
    for stroke in drawn(np.random.default_rng(1), 6, (0.1, 0.3), (3.0, 6.0), 0.02):
        forward = np.sign(stroke.end - stroke.begin)
        assert 0.1 <= forward * stroke.tilt <= 0.3, "turned counter-clockwise where it goes to the right"


def test_what_gets_going_in_the_middle_of_a_stroke_is_left_out_and_what_sticks_or_slides_is_kept() -> None:
    sticks = np.linspace(0.05, 0.31, 8)
    ratio = np.append(sticks, np.full(14, 0.33))
    gone = round(SWINGING / BIN)
    expected = [True] * 8 + [False] * gone + [True] * (14 - gone)
    assert steady(np.column_stack([np.full(22, 4.0), -4.0 * ratio])).tolist() == expected


@pytest.mark.parametrize("bins", [0, 1, 20])
def test_of_a_stroke_that_slides_all_along_nothing_is_left_out(bins: int) -> None:
    assert steady(np.tile([4.0, 1.3], (bins, 1))).tolist() == [True] * bins


@pytest.mark.parametrize("turned", [-0.2, 0.0, 0.2])
@pytest.mark.parametrize("tilt", [-0.3, 0.3])
def test_where_a_zero_is_taken_the_object_is_free_of_the_face_however_the_hand_is_turned(tilt, turned) -> None:
    hbox = load_object("hbox")
    vertices, stiffness = hbox.polygon.vertices, load_sensor("soft_bubble").stiffness
    dragged = Dragged(vertices, np.zeros(3), 1e-3, stiffness, np.zeros(3), half=0.1)
    along = np.array([-0.01, 0.02])
    angles = tilt + np.array([turned, turned])
    for pose in clear(dragged, tilt, along, angles):
        # next to weightless, it hangs in the fingers as it lies in them
        assert se2.transform(pose, vertices)[:, 1].min() >= CLEARANCE - 1e-4
        assert pose[2] == tilt + turned
