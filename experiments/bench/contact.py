"""How well and how fast the contact is located from the wrist wrench: for `extrinsic bench estimation`.

Contacts of 3 N anywhere on the boundary, the force anywhere in the cone; the wrench as a wrist sensor 200 mm above the
grasp reports it, averaged over one camera period. Two sensors: white noise of the size that the issue names, and the
simulated ATI of the `lab` profile, tared ten seconds ago, with its drift, gain error and digits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.sim.force_torque import TARE_READINGS, Electronics
from drivers.sim.mismatch import load_profile
from estimation.cone_projection import cone_rays, project, square_root
from estimation.contact_filter import ContactFilter
from estimation.contact_location import ContactEstimate, ContactLocator, ContactPrior, ContactStatus
from estimation.contact_sites import ground_seen_by
from estimation.contact_wrench import EnvironmentWrench, loosened, wrist_covariance
from experiments.bench.figures import Figure, figure_of, median_of, seconds
from mechanics import se2
from mechanics import wrench as wrenches
from mechanics.catalogue import load_object
from mechanics.polygon import Polygon
from mechanics.readings import Array
from mechanics.task_plane import TaskPlane

MU = 0.33
#: size of the contact force [N]
FORCE = 3.0
#: readings in one camera period (1 kHz, 30 Hz)
READINGS = 33
#: the wrist sensor in the go's frame: 200 mm above a grasp that is 45 mm above the centroid
SENSOR = np.array([0.0, 0.245, 0.0])
#: one reading's noise that the issue names (fx, fy [N], τ [N·m])
ATI = np.array([0.05, 0.05, 0.002])
#: how long ago the sensor of the lab was tared, and its rate [s, Hz]
SINCE_TARE, RATE = 10.0, 1000.0
#: beyond this a place is another place [m]
APART = 0.005
#: what a tilted go is known to: height [m] and angle [rad]
POSE_ERROR = (0.0003, np.radians(0.5))

L = Polygon(np.array([[0, 0], [80, 0], [80, 30], [30, 30], [30, 120], [0, 120]]) * 1e-3).centred()
U = Polygon(np.array([[0, 0], [100, 0], [100, 90], [70, 90], [70, 30], [30, 30], [30, 90], [0, 90]]) * 1e-3).centred()
OUTLINES = {name: load_object(name).polygon for name in ("tall_box", "pentagon", "z")} | {"L": L, "U": U}

#: turns a true wrench about the go's origin into what is known of it
Sensor = Callable[[Array, np.random.Generator], EnvironmentWrench]


@dataclass(frozen=True)
class Touches:
    """Contacts (n): ``points`` (n, 2), their ``faces`` (n,), ``forces`` (n, 2) on the go, in go."""

    points: Array
    faces: NDArray[np.int64]
    forces: Array


def touches(outline: Polygon, n: int, rng: np.random.Generator) -> Touches:
    """Contacts spread evenly over the boundary, forces of `FORCE` spread evenly over the angles of the cone."""
    boundary = outline.boundary(2e-4)
    k = rng.choice(len(boundary.points), size=n, p=boundary.lengths / boundary.lengths.sum())
    angle = rng.uniform(-1, 1, n) * np.arctan(MU)
    return Touches(boundary.points[k], boundary.faces[k], FORCE * se2.rotate(angle, -boundary.normals[k]))


def wrench_of(point: Array, force: Array) -> Array:
    """The wrench (..., 3) about the go's origin of a ``force`` (..., 2) at a ``point`` (..., 2)."""
    torque = point[..., 0] * force[..., 1] - point[..., 1] * force[..., 0]
    return np.concatenate([force, torque[..., None]], axis=-1)


def white(wrench: Array, rng: np.random.Generator) -> EnvironmentWrench:
    """The mean of a camera period's readings with white noise."""
    at_sensor = wrenches.about(wrench, np.zeros(2), SENSOR[:2]) + ATI / np.sqrt(READINGS) * rng.standard_normal(3)
    covariance = wrist_covariance(np.diag(ATI**2) / READINGS, SENSOR, np.zeros(2))
    return EnvironmentWrench.of(wrenches.about(at_sensor, SENSOR[:2], np.zeros(2)), covariance)


def lab(wrench: Array, rng: np.random.Generator) -> EnvironmentWrench:
    """The mean of a camera period's readings of the `lab` profile's sensor, less its tare."""
    figures, plane = load_profile("lab").force_torque, TaskPlane()
    electronics = Electronics(figures, RATE, rng)

    def mean(load: Array, n: int) -> Array:
        spatial = plane.wrench_to_spatial(load)
        return plane.wrench_to_planar(np.mean([electronics.read(spatial)[0] for _ in range(n)], axis=0))

    # a load on the sensor at the tare, so that its digits change from reading to reading as a tool's weight makes them
    zero = mean(np.zeros(3), TARE_READINGS)
    mean(np.zeros(3), round(SINCE_TARE * RATE))
    about_sensor = wrenches.about(wrench, np.zeros(2), SENSOR[:2])
    read = mean(about_sensor, READINGS) - zero
    # from the sensor's own figures, as a data sheet has them: noise, digits, and what ten seconds of drift leave
    noise = np.array([figures.noise[0], figures.noise[2], figures.noise[4]])
    digits = np.array([figures.resolution[0], figures.resolution[2], figures.resolution[4]]) / np.sqrt(12)
    white_part = np.diag(noise**2 + digits**2) / READINGS
    drift = np.array([figures.drift_force, figures.drift_force, figures.drift_torque]) * np.sqrt(SINCE_TARE / 30)
    slow = np.diag(drift**2 + (figures.gain_error * np.array([FORCE, FORCE, FORCE * SENSOR[1]])) ** 2)
    covariance = wrist_covariance(white_part, SENSOR, np.zeros(2))
    estimate = EnvironmentWrench.of(wrenches.about(read, SENSOR[:2], np.zeros(2)), covariance)
    return loosened(estimate, wrist_covariance(slow, SENSOR, np.zeros(2)))


@dataclass(frozen=True)
class Accuracy:
    """One row of the table: the error of the best hypothesis [mm], whatever the status says of it.

    ``kept`` is the share of contacts whose true face (or vertex) is among the hypotheses, ``first`` the share where
    the best hypothesis lies within 5 mm of the truth, ``told`` the share of status OK, ``misled`` [mm] the
    largest error under OK, ``answers`` how many places more than 5 mm apart are kept on average.
    """

    shape: str
    median_mm: float
    p95_mm: float
    kept: float
    first: float
    told: float
    misled: float
    answers: float


def accuracy(shape: str, n: int, sensor: Sensor = white, prior: float | None = None, seed: int = 0) -> Accuracy:
    """Contacts on the boundary of a shape; ``prior`` [m] is the deviation of a belief about the point, if any."""
    rng = np.random.default_rng(seed)
    outline = OUTLINES[shape]
    true = touches(outline, n, rng)
    locator = ContactLocator(outline, MU)
    found = []
    for point, wrench in zip(true.points, wrench_of(true.points, true.forces), strict=True):
        believed = None if prior is None else ContactPrior(point + prior * rng.standard_normal(2), prior)
        found.append(locator.locate(sensor(wrench, rng), prior=believed))
    kept = [any(h.face == face for h in e.hypotheses) for e, face in zip(found, true.faces, strict=True)]
    return _row(shape, found, true.points, kept)


def on_the_floor(shape: str, n: int, sensor: Sensor = white, seed: int = 0) -> Accuracy:
    """A go tilted by 5° to 40° stands on a vertex; its pose is known to `POSE_ERROR`, and every face is a candidate."""
    rng = np.random.default_rng(seed)
    outline = OUTLINES[shape]
    locator = ContactLocator(outline, MU)
    found, points, kept = [], [], []
    for _ in range(n):
        tilt = rng.choice([-1, 1]) * np.radians(rng.uniform(5, 40))
        heights = outline.transformed((0.0, 0.0, tilt)).vertices[:, 1]
        vertex = int(heights.argmin())
        pose = np.array([0.1, -heights[vertex], tilt])
        angle = rng.uniform(-1, 1) * np.arctan(MU)
        force = se2.rotate(-tilt, FORCE * np.array([np.sin(angle), np.cos(angle)]))
        point = outline.vertices[vertex]
        seen = pose + rng.standard_normal(3) * [0.0, *POSE_ERROR]
        found.append(locator.locate(sensor(wrench_of(point, force), rng), [ground_seen_by(seen)]))
        points.append(point)
        kept.append(any(h.vertex == vertex for h in found[-1].hypotheses))
    return _row(f"{shape}, tilted on the floor", found, np.array(points), kept)


def _row(shape: str, found: list[ContactEstimate], points: Array, kept: list[bool]) -> Accuracy:
    nothing = np.full(2, np.nan)
    best = np.array([e.hypotheses[0].point if e.hypotheses else nothing for e in found])
    error = np.linalg.norm(best - points, axis=1)
    ranked = np.where(np.isnan(error), np.inf, error)  # no answer is no success
    told = np.array([e.status is ContactStatus.OK for e in found])
    places = [
        1 + sum(bool(np.linalg.norm(h.point - e.hypotheses[0].point) > APART) for h in e.hypotheses[1:])
        for e in found
        if e.hypotheses
    ]
    return Accuracy(
        shape,
        1e3 * float(np.median(ranked)),
        1e3 * float(np.quantile(ranked, 0.95, method="higher")),
        float(np.mean(kept)),
        float(np.mean(ranked < APART)),
        float(told.mean()),
        1e3 * float(error[told].max(initial=0.0)),
        float(np.mean(places)) if places else 0.0,
    )


def table(n: int = 400) -> list[Accuracy]:
    """The accuracy table with white ATI noise."""
    return [*(accuracy(shape, n) for shape in OUTLINES), on_the_floor("tall_box", n), on_the_floor("pentagon", n)]


def candidates_ms(runs: int, n: int = 1000) -> Figure:
    """The friction-cone program at ``n`` points of the box, one wrench."""
    outline = OUTLINES["tall_box"]
    perimeter = float(np.linalg.norm(np.roll(outline.vertices, -1, axis=0) - outline.vertices, axis=1).sum())
    boundary = outline.boundary(perimeter / (n + len(outline)))
    points, rays = boundary.points[:n], cone_rays(-boundary.normals[:n], MU)
    measured = _example()
    root = square_root(measured.information)
    work = lambda: project(points, rays, measured.wrench, root, measured.about)  # noqa: E731
    assert work().chi2.shape == (n,)
    return median_of(f"{n} contact candidates", lambda: 1e3 * seconds(work), "ms", max(20, runs))


def costs(runs: int) -> Iterator[Figure]:
    """Time of a search, of a contact located, and of an update of the filter."""
    yield candidates_ms(runs)
    locator, measured = ContactLocator(OUTLINES["z"], MU), _example()
    yield median_of(
        "contact located", lambda: 1e3 * seconds(lambda: locator.locate(measured)), "ms", max(20, runs), "z"
    )
    particles = ContactFilter(locator, np.random.default_rng(0))
    step = lambda: particles.update(1 / 30, measured)  # noqa: E731
    yield median_of("contact filter update", lambda: 1e3 * seconds(step), "ms", max(20, runs), "z, 500 particles")


def _example() -> EnvironmentWrench:
    """A push from below on z and box alike."""
    return white(wrench_of(np.array([0.0, -0.0634]), np.array([0.3, FORCE])), np.random.default_rng(0))


def run(runs: int = 5) -> Iterator[Figure]:
    """Every figure of contact location, in the order of the table."""
    yield from costs(runs)
    n = max(100, 80 * runs)
    for row in table(n):
        yield figure_of(f"contact on {row.shape}: median", [row.median_mm], "mm", f"{n} contacts, ATI noise")
        yield figure_of(f"contact on {row.shape}: 95 %", [row.p95_mm], "mm")
        yield figure_of(f"contact on {row.shape}: true place kept", [row.kept], "")
    for shape in ("z", "L", "U"):
        row = accuracy(shape, n, prior=0.005)
        yield figure_of(f"contact on {shape}: a 5 mm prior picks the place", [row.first], "")
    for shape in ("tall_box", "pentagon"):
        row = accuracy(shape, max(20, n // 10), sensor=lab)
        yield figure_of(f"contact on {shape}, lab sensor: median", [row.median_mm], "mm", "tared 10 s ago")
        yield figure_of(f"contact on {shape}, lab sensor: 95 %", [row.p95_mm], "mm")
