"""The arithmetic of `extrinsic bench load`, and the whole of it for a few seconds."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from scipy import stats

from experiments.bench import Options, load, main
from experiments.bench.figures import Figure, targets_of
from experiments.bench.load_ticks import Ticks, figures, ratio, schedule, ticks_of
from experiments.bench.memory import own_memory, slope
from mechanics.yaml_input import InputError

T = np.arange(0.0, 1200.0, 2.0)


# -- memory -----------------------------------------------------------------------------------------------------------


def test_a_straight_line_has_its_slope_per_hour_and_no_width():
    found = slope(T, 200 + 3.0 * T / 3600, after=120, block=60)
    assert (found.slope, found.low, found.high) == pytest.approx((3.0, 3.0, 3.0), rel=1e-9)
    assert found.blocks == 18


def test_what_came_in_the_warm_up_does_not_count():
    sizes = 200 - 1.5 * T / 3600 - 80 * (T < 115)
    assert slope(T, sizes, after=120, block=60).slope == pytest.approx(-1.5)


def test_the_slope_is_that_of_the_block_means():
    rng = np.random.default_rng(3)
    sizes = 200 + 5 * T / 3600 + rng.normal(size=T.size)
    blocks = sizes[60:].reshape(-1, 30).mean(axis=1)
    expected = stats.linregress(T[60:].reshape(-1, 30).mean(axis=1) / 3600, blocks)
    found = slope(T, sizes, after=120, block=60)
    assert found.slope == pytest.approx(expected.slope, rel=1e-9)  # type: ignore[attr-defined]
    least = stats.t.ppf(0.975, 16) * expected.stderr  # type: ignore[attr-defined]
    assert found.high - found.slope >= 0.999 * least, "never narrower than for independent blocks"


@pytest.mark.parametrize("memory", [0.0, 0.9, 0.98], ids=["white", "20 s", "100 s"])
def test_the_interval_holds_the_true_slope_19_times_in_20_or_nearly_though_samples_hang_together(memory: float):
    """Noise of an AR(1) process whose memory is up to two blocks long; without regard to it a third would miss."""
    held = 0
    for seed in range(200):
        rng = np.random.default_rng(seed)
        shocks, noise = rng.normal(size=T.size), np.zeros(T.size)
        noise[0] = shocks[0] / np.sqrt(1 - memory**2)
        for i in range(1, T.size):
            noise[i] = memory * noise[i - 1] + shocks[i]
        found = slope(T, 200 + 5 * T / 3600 + 0.05 * noise, after=120, block=60)
        held += found.low <= 5 <= found.high
    assert held >= 0.9 * 200


def test_three_blocks_tell_no_slope():
    with pytest.raises(ValueError, match="4 blocks of 60 s or more after 120 s, got 3"):
        slope(T[:150], T[:150], after=120, block=60)


def test_what_a_process_has_for_itself_is_what_it_filled_and_an_ended_one_has_nothing():
    command = [
        sys.executable,
        "-c",
        "b = bytes(b'x' * 80_000_000); print(flush=True); input(); del b; print(flush=True); input()",
    ]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdin is not None and child.stdout is not None
        child.stdout.readline()
        full = own_memory(child.pid)
        child.stdin.write(b"\n")
        child.stdin.flush()
        child.stdout.readline()
        empty = own_memory(child.pid)
        assert full is not None and empty is not None
        assert full - empty == pytest.approx(80.0, abs=1.0)
    assert own_memory(child.pid) is None


# -- the loop ---------------------------------------------------------------------------------------------------------


def test_a_tick_is_what_lies_between_two_sleeps_of_the_loop():
    sleeps = np.array(
        [
            [10.0, 0.02, 0.021, 1],  # wakes at 10.021
            [10.024, 0.017, 0.017, 1],  # worked 3 ms, slept on time, wakes at 10.041
            [10.050, 0.02, 0.02, 0],  # waits for something else, whose time says nothing
            [11.0, 0.02, 0.025, 1],
            [11.030, 0.01, 0.012, 1],  # worked 5 ms, 2 ms late
        ]
    )
    found = ticks_of(sleeps)
    np.testing.assert_allclose(found.at, [10.021, 11.025])
    np.testing.assert_allclose(found.work, [0.003, 0.005], atol=1e-9)
    np.testing.assert_allclose(found.late, [0.0, 0.002], atol=1e-9)
    np.testing.assert_allclose(found.period, [0.020, 0.017], atol=1e-9)


def test_phases_fill_their_time_in_pairs_and_a_drift_favours_neither_kind():
    phases = schedule(100.0, 1080.0, 30.0, 2.0)
    assert len(phases) == 36
    assert (phases[0].begin, phases[0].end, phases[-1].end) == (102.0, 130.0, 1180.0)
    assert all(first.viewers is not second.viewers for first, second in zip(phases[::2], phases[1::2], strict=True))
    middles = {kind: np.mean([p.begin + p.end for p in phases if p.viewers is kind]) / 2 for kind in (True, False)}
    assert middles[True] == pytest.approx(middles[False])
    assert len(schedule(0.0, 8.0, 30.0, 0.1)) == 8, "four pairs, however short"


def looped(factor: float, noise: float, seed: int) -> Figure | None:
    """A loop whose work drifts by half, is ``factor`` of itself with viewers, and scatters."""
    phases = schedule(0.0, 1080.0, 30.0, 2.0)
    at = np.arange(0.0, 1080.0, 0.02)
    looked_at = np.zeros(at.size, bool)
    for phase in phases:
        looked_at |= phase.viewers & (at >= phase.begin - 2.0) & (at < phase.end)
    rng = np.random.default_rng(seed)
    work = 0.004 * (1 + 0.5 * at / at[-1]) * np.where(looked_at, factor, 1.0) * rng.lognormal(0.0, noise, at.size)
    ticks = Ticks(at, work, 0 * at, work + 0.02)
    return ratio("work", ticks, phases, lambda part: float(part.work.mean()), "")


def test_a_loop_whose_work_takes_six_percent_longer_with_viewers_is_told_so():
    found = looped(1.06, 0.0, 0)
    assert found is not None and found.median == pytest.approx(1.06, rel=1e-3) and found.runs == 18
    noisy = looped(1.06, 0.5, 1)
    assert noisy is not None and noisy.low < 1.06 < noisy.high and noisy.low > 1.0


def test_phases_without_ticks_tell_nothing():
    phases = schedule(0.0, 8.0, 30.0, 0.1)
    nothing = Ticks(*(np.zeros(0),) * 4)
    assert ratio("work", nothing, phases, lambda part: float(part.work.mean()), "") is None
    assert figures(nothing, phases, 4) == figures(nothing, [], 4) == []


# -- losses -----------------------------------------------------------------------------------------------------------


def test_a_loss_is_a_gap_or_what_was_published_and_not_logged_or_a_stream_that_is_missing():
    log = {
        "messages": {"sim/arm/pose": 100, "sim/wrist_ft/wrench": 990, "sim/left/image": 28},
        "published": {"sim/arm/pose": 99, "sim/wrist_ft/wrench": 1000, "sim/left/image": 30, "sim/right/image": 5},
        "gaps": {"sim/wrist_ft/wrench": 10, "sim/left/image": 1},
        "lost": 17,
    }
    found = {figure.name: figure.median for figure in load.losses(log)}
    assert found == {
        "sim/arm/pose: lost": 0,
        "sim/wrist_ft/wrench: lost": 10,
        "sim/left/image: lost": 2,
        "readings lost": 17,
    }


# -- the whole --------------------------------------------------------------------------------------------------------

SMALL = [f"devices.finger_{side}.{key}" for side in ("left", "right") for key in ("width=64", "height=48", "rate=10")]


@pytest.mark.alone
def test_a_few_seconds_of_load_give_every_figure_and_lose_nothing():
    sets = [*SMALL, "devices.camera.rate=1", "devices.wrist_ft.rate=200", "devices.table_ft.rate=200"]
    found = {figure.name: figure for figure in load.run(0.07, 1, [*sets, "world.timestep=0.002"])}
    assert found["readings lost"].median == 0
    assert {f"sim/{stream}: lost" for stream in ("wrist_ft/wrench", "finger_left/image", "camera/detections")} <= {
        *found
    }
    assert found["viewers: messages"].median > 0
    for process in ("host", "runner", "viewer 1"):
        assert found[f"{process}: memory"].low > 1.0
        assert f"{process}: memory slope" in found
    # two ratios need phases with ticks enough, which a crowded machine may not grant in four seconds
    missing = {*targets_of("load")} - {*found}
    assert all(name.startswith("loop") for name in missing), missing


@pytest.mark.parametrize(
    ("name", "options", "said"),
    [
        ("sim", Options(minutes=1.0), "sim has no minutes"),
        ("planning", Options(viewers=2), "planning has no viewers"),
        ("load", Options(runs=3), "load has no runs"),
    ],
)
def test_options_belong_to_their_benchmarks(name: str, options: Options, said: str):
    with pytest.raises(InputError, match=said):
        main(name, options, None, None, False)
