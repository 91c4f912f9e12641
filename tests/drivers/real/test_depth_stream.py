"""A RealSense's units of depth and options, and the pace of its recordings."""

import subprocess
import sys
import threading
import weakref
from collections import deque
from types import SimpleNamespace

import numpy as np
import pytest

from drivers.errors import NotConnected
from drivers.real import realsense
from drivers.real.depth_stream import _Pace, depth_steps
from drivers.real.realsense import resolved, set_option
from tests.drivers.real.bubbles import bubble


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


#: opens and closes a recording at any moment, and says so at the end, unless the library ends it first
_OFTEN = """
import random, sys, time
from pathlib import Path
from drivers.real.depth_stream import DepthStream
from drivers.real.realsense_bubble import RealSenseBubbleConfig
from tests.drivers.real.bubbles import LENS, entry, dome, record
file = record(Path(sys.argv[1]), [dome(320, 240, LENS)] * 6)
moments = random.Random(int(sys.argv[2]))
for n in range(400):
    stream = DepthStream("finger", RealSenseBubbleConfig.model_validate(entry(recording=str(file), loop=True)))
    stream.open(5.0)
    for _ in range(moments.randint(0, 10)):
        stream.take(0.05)
    time.sleep(moments.uniform(0.0, 0.05))
    stream.close()
print("all")
"""


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_recording_may_be_opened_and_closed_at_any_moment(rs, tmp_path):
    children = [  # beside one another: it is where threads are held up that the library lost its way
        subprocess.Popen(
            [sys.executable, "-c", _OFTEN, str(tmp_path / f"{n}.db3"), str(n)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for n in range(6)
    ]
    try:
        ended = [(child.communicate(timeout=500), child.returncode) for child in children]
    finally:
        for child in children:
            child.kill()
            child.wait()
    for (out, err), code in ended:
        assert (code, out) == (0, "all\n"), err


def test_what_has_played_a_recording_outlives_its_stop(still, monkeypatch):
    now = 100.0
    monkeypatch.setattr(realsense, "_rested", deque())
    monkeypatch.setattr(realsense, "time", SimpleNamespace(monotonic=lambda: now))
    player = threading.Event()
    gone = weakref.ref(player)
    realsense.rest(player)
    del player
    now += 4.9
    realsense.rest()
    assert gone() is not None
    now += 0.2
    realsense.rest()
    assert gone() is None
    monkeypatch.undo()

    monkeypatch.setattr(realsense, "_rested", rested := deque())
    with bubble(recording=str(still)) as finger:
        finger.latest()
    ((_, (pipeline, playback)),) = rested
    assert type(pipeline).__name__ == "pipeline" and playback.is_playback()
