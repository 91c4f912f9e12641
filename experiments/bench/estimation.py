"""`extrinsic bench estimation`: time per frame and per update beside the sensor's period, and how right they are.

Accuracies are of the simulated sensors under the `lab` profile, over random grasps and contacts; the methods of the
paper stand beside the better ones in the same table.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from estimation.force_torque import FreeAirLoad, WristSensor
from estimation.grasp_filter import GraspFilter
from estimation.state import StateEstimator
from experiments.bench import contact, identification
from experiments.bench.figures import Figure, Part, figure_of, in_parts, median_of, seconds
from experiments.bench.tactile import Row, accuracy, random_grasps
from experiments.bench.tactile_gel import FAMILIES, GRASPS
from experiments.calibrate.threads import one_thread
from experiments.progress import Heard, unheard
from mechanics.catalogue import load_sensor
from mechanics.elasticity import Elasticity
from mechanics.readings import PoseReading, Stamp, WrenchReading

SEED = 20
#: random grasps of each sensor, for every run that is asked for
GRASPS_PER_RUN = 20
MS = 1_000_000


def run(runs: int = 5, heard: Heard = unheard) -> Iterator[Figure]:
    """Measure everything, figure by figure, linear algebra on one thread."""
    seeds = max(2, runs // 2)
    parts: list[Part] = [
        (15 * runs, lambda: _poses("soft_bubble", runs)),
        (35 * runs, lambda: _poses("gelslim", runs)),
        (0.1 * runs, lambda: [_update(runs)]),
        (4 * runs, lambda: contact.run(runs)),
        (40 * seeds, lambda: identification.elasticity(seeds)),
        (1.5 * runs, lambda: identification.friction(4 * runs)),
    ]
    with one_thread():
        yield from in_parts(parts, heard)


def _poses(sensor: str, runs: int) -> Iterator[Figure]:
    places = GRASPS if sensor == "gelslim" else None
    grasps = random_grasps(FAMILIES[sensor], GRASPS_PER_RUN * runs, SEED, places)
    for row in accuracy(sensor, grasps, SEED, FAMILIES):
        yield from _pose(sensor, row)


def _pose(sensor: str, row: Row) -> Iterator[Figure]:
    name, what = f"{sensor}, {row.method}", f"{row.grasps} grasps, lab"
    yield figure_of(f"{name}: rms position", [row.rms_mm], "mm", what)
    yield figure_of(f"{name}: rms angle", [row.rms_deg], "deg", what)
    yield figure_of(f"{name}: beyond 1 mm or 2 deg", [100 * row.far], "%", what)
    yield figure_of(f"{name}: normalised error, median", [row.nees_median], "× χ²", what)
    yield figure_of(f"{name}: normalised error, mean", [row.nees_mean], "× dims", what)
    yield figure_of(f"{name}: unobserved and flagged", [100 * row.flagged], "%", what)
    yield figure_of(f"{name}: frame of one finger", [row.ms], "ms", "period 33 ms")


def _update(runs: int) -> Figure:
    """What a control period costs the state estimator: 20 wrenches, two poses, one state."""
    stiffness = load_sensor("soft_bubble").stiffness
    wrist = WristSensor(np.array([0.0, 0.2, 0.0]), np.zeros(3))
    made = StateEstimator(
        GraspFilter(np.array([0.0, 0.045, 0.0])), Elasticity(stiffness), wrist, FreeAirLoad(0.1, np.zeros(2))
    )
    ee, reading = np.array([0.0, 0.2, 0.1]), np.array([0.5, 0.0, 2.0, 0.0, 0.1, 0.0])
    clock = [0]

    def period() -> None:
        for i in range(20):
            clock[0] += MS
            stamp = Stamp(clock[0], clock[0], clock[0] // MS, "wrist")
            made.push_wrench(WrenchReading(stamp, reading))
            if i % 10 == 0:
                made.push_pose(PoseReading(stamp, ee))
        made.state()

    for _ in range(10):
        period()
    return median_of("state estimate", lambda: 1e3 * seconds(period), "ms", 10 * runs, "period 20 ms")
