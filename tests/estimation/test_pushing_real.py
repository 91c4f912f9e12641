"""Friction of recorded planar pushes: the same block on the same table resists alike in every run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from estimation.friction_fit import sliding_forces
from tests.recordings import DATA, recorded

FOLDER = DATA / "pushing"
pytestmark = recorded("pushing")


def columns(path: Path, width: int) -> np.ndarray:
    """Rows (n, width) of a file with one number a line; the first of a row is its stamp [ns]."""
    return np.loadtxt(path).reshape(-1, width)


def median_sliding_force(block: str, run: int) -> float:
    """Median |F| [N] while the block slides."""
    force = columns(FOLDER / f"{block}_block" / f"metal_{run}_ft.txt", 3)
    pose = columns(FOLDER / f"{block}_block" / f"metal_{run}_obj.txt", 7)
    begin = force[0, 0]
    times, seen = (force[:, 0] - begin) * 1e-9, (pose[:, 0] - begin) * 1e-9
    # nothing touches the pusher in the first half second: the sensor's zero, which is 2 N off with the steel block
    tared = force[:, 1:] - np.median(force[times < 0.5, 1:], axis=0)
    sliding = sliding_forces(tared, times, pose[:, 1:3], seen)
    assert len(sliding) > 100
    return float(np.median(np.linalg.norm(sliding, axis=1)))


@pytest.mark.parametrize("block", ["Al", "St"])
def test_the_sliding_force_of_a_block_is_the_same_in_three_runs(block):
    forces = np.array([median_sliding_force(block, run) for run in (1, 2, 3)])
    middle = 0.5 * (forces.max() + forces.min())
    assert np.abs(forces / middle - 1).max() <= 0.05


def test_the_heavier_block_resists_more():
    # the recording's own summary: 0.89 to 0.97 N for aluminium, 1.98 to 2.16 N for steel
    assert 0.85 < median_sliding_force("Al", 1) < 1.0
    assert 1.9 < median_sliding_force("St", 1) < 2.2
