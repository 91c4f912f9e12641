"""`extrinsic bench bus`: what it counts, and that it measures both ways and both stations."""

import json

import numpy as np
import pytest

from drivers.wire import messages
from drivers.wire.codec import encode_reading
from drivers.wire.streams import Sample
from experiments.bench import bus, figures
from mechanics.readings import Stamp, WrenchReading


def sample(sequence, age_ms):
    reading = WrenchReading(Stamp(0, 0, sequence, "wrist_ft"), np.zeros(6))
    captured = bus.time.time_ns() - round(age_ms * 1e6)
    return Sample("t", encode_reading(reading), sequence, captured, 0, 0)


def test_a_message_that_never_comes_is_lost_and_one_that_comes_twice_is_one():
    taken = bus._Taken()
    take = taken.ours(messages.WRENCH)
    for sequence in (0, 1, 1, 3):
        take(sample(sequence, 5.0))
    ages, lost = taken.take(4)
    assert lost == 1
    assert len(ages) == 3
    assert (ages >= 5.0).all()


def test_each_piece_begins_anew():
    taken = bus._Taken()
    taken.ours(messages.WRENCH)(sample(0, 1.0))
    taken.take(1)
    taken.ours(messages.WRENCH)(sample(7, 1.0))
    ages, lost = taken.take(1)
    assert (len(ages), lost) == (1, 0)


def test_every_target_is_of_a_figure_that_is_measured():
    measured = {
        f"{name}, {way}: {what}"
        for name in bus.NAMES.values()
        for way in ("direct", "routed")
        for what in ("p50 over bare zenoh's", "lost")
    }
    measured |= {f"idle station, {what}: of one core" for what in ("real backends", "simulated in real time")}
    assert set(figures.targets_of("bus")) <= measured


@pytest.mark.slow
def test_the_bench_measures_both_ways_and_both_stations(shared_command):
    file = shared_command.folder / "bus.json"
    done = shared_command.finish(
        shared_command.start("bench", "bus", "--minutes", "0.1", "--json", str(file)), timeout=300
    )
    assert done.code == 0, done.err
    found = {figure["name"]: figure for figure in json.loads(file.read_text())["figures"]}
    assert set(figures.targets_of("bus")) <= set(found)
    for name, figure in found.items():
        if name.endswith("lost"):
            assert figure["median"] == 0, name
