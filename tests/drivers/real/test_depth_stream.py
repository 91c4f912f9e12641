"""A RealSense's units of depth and options, and the pace of its recordings."""

import threading
from types import SimpleNamespace

import numpy as np
import pytest

from drivers.errors import NotConnected
from drivers.real.depth_stream import _Pace, depth_steps
from drivers.real.realsense import resolved, set_option


@pytest.mark.parametrize("unit", [1e-4, 1e-3, 2.5e-4, 1e-5])
def test_steps_of_depth_are_the_nearest_and_none_where_none_is(unit):
    steps = depth_steps(unit)
    assert steps.dtype == np.uint16 and len(steps) == 65536 and steps[0] == 0
    for figure in (1, 7, 400, 6553, 65535):
        expected = figure * unit / 1e-4
        assert steps[figure] == (pytest.approx(expected, abs=0.5001) if expected < 65535.5 else 0)


# -- a recording's pace, and a camera's options ------------------------------------------------------------------------


def test_a_recording_keeps_the_cameras_own_pace_and_begins_again_a_period_later():
    pace = _Pace(0.1)
    frames = [(1, 0.0), (2, 0.1), (5, 0.4), (1, 0.0), (2, 0.1)]
    due = [pace.due(number, round(told * 1e9), 50.0) for number, told in frames]
    assert due == pytest.approx([50.0, 50.1, 50.4, 50.5, 50.6])


def test_who_is_held_up_does_not_make_up_for_it():
    pace = _Pace(0.1)
    assert [pace.due(n, n * 100_000_000, now) for n, now in ((1, 5.0), (2, 5.3), (3, 9.0), (4, 9.0))] == pytest.approx(
        [5.0, 5.1, 9.0, 9.1]
    )


@pytest.fixture
def projector(rs):
    """A camera's sensor in software, with a projector of 0 to 360 mW in steps of 30."""
    camera = rs.software_device()
    sensor, span = camera.add_sensor("Stereo Module"), rs.option_range()
    span.min, span.max, span.default, span.step = 0, 360, 150, 30
    sensor.add_option(rs.option.laser_power, span, True)
    sensor.add_read_only_option(rs.option.depth_units, 1e-4)
    yield sensor
    del camera


def test_an_option_is_set(rs, projector):
    set_option(rs, "finger_left", "connect", projector, "laser_power", 90.0)
    assert projector.get_option(rs.option.laser_power) == 90.0


@pytest.mark.parametrize(
    ("option", "value", "told"),
    [
        ("laser_power", 400.0, "cannot be 400. It can be from 0 to 360"),
        ("depth_units", 1e-3, "depth_units cannot be set"),
        ("visual_preset", "Hand", "visual_preset cannot be set"),
    ],
)
def test_an_option_that_it_has_not_is_refused(rs, projector, option, value, told):
    with pytest.raises(NotConnected, match=told):
        set_option(rs, "finger_left", "connect", projector, option, value)


class Preset:
    """Stands for a sensor whose preset has names, which none in software has."""

    names = ("Custom", "Default", "Hand", "High Accuracy")
    chosen = -1.0

    def supports(self, _):
        return True

    def is_option_read_only(self, _):
        return False

    def get_option_range(self, _):
        return SimpleNamespace(min=0.0, max=3.0, step=1.0)

    def get_option_value_description(self, _, value):
        return self.names[int(value)]

    def set_option(self, _, value):
        self.chosen = value


def test_a_preset_is_chosen_by_its_name(rs):
    sensor = Preset()
    set_option(rs, "finger_left", "connect", sensor, "visual_preset", "high accuracy")
    assert sensor.chosen == 3.0
    with pytest.raises(NotConnected, match=r"never 'Best'\. It can be Custom, Default, Hand, High Accuracy"):
        set_option(rs, "finger_left", "connect", sensor, "visual_preset", "Best")


def test_a_library_that_does_not_answer_is_not_waited_for():
    hung = threading.Event()
    config = SimpleNamespace(resolve=lambda _: hung.wait(30))
    try:
        with pytest.raises(NotConnected, match=r"no answer within 0\.1 s"):
            resolved("finger_left", "connect", None, config, 0.1, str)
    finally:
        hung.set()
