"""How well each tactile method finds the held object: random grasps, rendered with the `lab` profile's noise.

A sensor family is a `Family`: how its fingers are opened, which methods read them, and which stretch of an outline
they truly show. `FAMILIES` has those that are measured; another file adds its own.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.stats import chi2

from drivers.config import TactileConfig
from drivers.interfaces import TactileSensor
from drivers.sim.bubble_geometry import DOME
from drivers.sim.finger import FingerView
from drivers.sim.mismatch import Mismatch, load_profile
from estimation.tactile_pose import (
    ANGLE_LENGTH,
    FingerModel,
    GraspPrior,
    PoseStatus,
    TactilePose,
    TactilePoseEstimator,
    fuse,
    left_difference,
    left_moved,
    open_directions,
)
from mechanics import se2
from mechanics.catalogue import load_object
from mechanics.polygon import Polygon
from mechanics.readings import Array

#: a failure is an error beyond these [m, rad]
FAR, FAR_TURNED = 1e-3, np.radians(2.0)
#: places (x, y, θ) [m, m, rad] of the fingers in each object where corners or sides that are not parallel show
GRASPS: dict[str, tuple[tuple[float, float, float], ...]] = {
    "tall_box": ((0.0, 0.045, 0.0), (0.0, -0.05, 0.4), (0.01, 0.05, 1.2)),
    "triangle": ((0.0, 0.035, 0.0), (0.03, -0.015, 0.5)),
    "pentagon": ((0.0, 0.04, 0.0), (-0.03, -0.03, -0.4)),
    "heptagon": ((0.0, 0.045, 0.0), (0.045, -0.035, 0.8)),
    "z": ((0.012, 0.042, 0.0), (-0.015, -0.03, 0.3)),
}
_AXES = np.array([1.0, 1.0, ANGLE_LENGTH])


@dataclass(frozen=True, eq=False)
class Grasp:
    """An object in the fingers: its ``outline`` and true pose ``X_ee_go`` (3,), what is believed, how deep it sits."""

    outline: Polygon
    X_ee_go: Array
    prior: GraspPrior
    indentation: float


@dataclass
class Hand:
    """A world that is nothing but a held object between two fingers."""

    profile: Mismatch
    outline: Array = field(default_factory=lambda: np.zeros((3, 2)))
    X_ee_go: Array = field(default_factory=lambda: np.zeros(3))
    held: bool = True
    lockstep: bool = True
    now: int = 0

    def now_ns(self) -> int:
        """A second after the last time: no frame has the noise of the one before."""
        self.now += 1_000_000_000
        return self.now

    def finger_view(self) -> FingerView:
        """The object as it was laid in."""
        return FingerView(self.outline, self.X_ee_go, np.zeros(3), self.held)


@dataclass(frozen=True)
class Family:
    """A kind of tactile finger, to be measured.

    ``open(hand, finger, indentation)`` gives the device; ``methods(model, outline)`` what reads it; ``shown(grasp)``
    points (m, 2) in ee of the boundary that a finger truly shows and their normals (m, 2). ``indentations`` [m] are
    those that grasps are drawn from.
    """

    open: Callable[[Hand, str, float], TactileSensor]
    methods: Callable[[FingerModel, Polygon], Sequence[TactilePoseEstimator]]
    shown: Callable[[Grasp], tuple[Array, Array]]
    indentations: tuple[float, ...]


@dataclass(frozen=True)
class Row:
    """One method's line of the table; `accuracy` says of what.

    ``rms_mm`` per observed axis and ``rms_deg``, over the observed directions of the poses that were given; ``far`` is
    the share of them beyond `FAR` or `FAR_TURNED`, ``silent`` that of the grasps without a pose. ``nees_median`` is
    over the median of χ², ``nees_mean`` over the dimensions; ``flagged`` is the share of the truly unobserved
    directions that were said to be, ``open`` how many directions a grasp leaves open in the mean. ``ms`` is per frame
    of one finger.
    """

    method: str
    grasps: int
    rms_mm: float
    rms_deg: float
    far: float
    silent: float
    nees_median: float
    nees_mean: float
    flagged: float
    open: float
    ms: float


def random_grasps(
    family: Family,
    count: int,
    seed: int,
    places: dict[str, tuple[tuple[float, float, float], ...]] | None = None,
    prior: tuple[float, float] = (0.003, np.radians(4.0)),
) -> list[Grasp]:
    """Grasps at ``places`` (default: the tall box at the default grasp), off by what the ``prior`` [m, rad] allows."""
    rng = np.random.default_rng(seed)
    places = places or {"tall_box": GRASPS["tall_box"][:1]}
    everywhere = [(name, place) for name, many in places.items() for place in many]
    outlines = {name: load_object(name).polygon for name in places}
    deviation = np.array([prior[0], prior[0], prior[1]])
    out = []
    for k in range(count):
        name, place = everywhere[k % len(everywhere)]
        believed = GraspPrior(se2.inverse(np.array(place)), np.diag(deviation**2))
        true = left_moved(believed.pose, deviation * rng.standard_normal(3))
        out.append(Grasp(outlines[name], true, believed, float(rng.choice(family.indentations))))
    return out


@dataclass(frozen=True, eq=False)
class Estimate:
    """What one method said of one grasp."""

    grasp: Grasp
    pose: TactilePose
    fingers: tuple[TactilePose, ...]
    ms: float


def estimates(
    sensor: str, grasps: Sequence[Grasp], seed: int, families: dict[str, Family] | None = None
) -> dict[str, list[Estimate]]:
    """What each method of a ``sensor`` family says of each grasp: {method: [Estimate]}, two fingers fused."""
    family = (families or FAMILIES)[sensor]
    hand = Hand(load_profile("lab"))
    opened: dict[float, list[tuple[TactileSensor, FingerModel]]] = {}
    out: dict[str, list[Estimate]] = {}
    warm = set()
    for grasp in grasps:
        if grasp.indentation not in opened:
            devices = [family.open(hand, side, grasp.indentation) for side in ("left", "right")]
            for k, device in enumerate(devices):
                device.restart(np.random.default_rng([seed, len(opened), k]))  # type: ignore[attr-defined]
            opened[grasp.indentation] = [
                (device, FingerModel.of(device.describe().extra, device.reference())) for device in devices
            ]
        hand.outline, hand.X_ee_go = np.array(grasp.outline.vertices), grasp.X_ee_go
        pairs = opened[grasp.indentation]
        images = [device.capture() for device, _ in pairs]
        each = [family.methods(model, grasp.outline) for _, model in pairs]
        for many in zip(*each, strict=True):
            name = many[0].name
            if name not in warm:
                many[0].estimate(images[0], grasp.prior)  # compiles
                warm.add(name)
            begin = time.process_time()
            poses = tuple(method.estimate(image, grasp.prior) for method, image in zip(many, images, strict=True))
            ms = 1e3 * (time.process_time() - begin) / len(many)
            out.setdefault(name, []).append(Estimate(grasp, fuse(grasp.prior, poses), poses, ms))
    return out


def accuracy(sensor: str, grasps: Sequence[Grasp], seed: int, families: dict[str, Family] | None = None) -> list[Row]:
    """One `Row` for each method of a ``sensor`` family, two fingers fused."""
    shown = (families or FAMILIES)[sensor].shown
    return [row(name, many, shown) for name, many in estimates(sensor, grasps, seed, families).items()]


def row(method: str, many: Sequence[Estimate], shown: Callable[[Grasp], tuple[Array, Array]]) -> Row:
    """The table's line of what a method said."""
    squares, axes, turns, far, silent, ratio, share = 0.0, 0, [], 0, 0, [], []
    unseen, said, left_open = 0, 0, 0
    for one in many:
        error = left_difference(one.pose.pose, one.grasp.X_ee_go)
        closed = np.eye(3) - one.pose.unobserved.T @ one.pose.unobserved
        observed = closed @ (error * _AXES) / _AXES
        basis = np.linalg.svd(closed)[0][:, : 3 - len(one.pose.unobserved)]
        left_open += len(one.pose.unobserved)
        truly = unobserved(one.grasp, shown)
        unseen += len(truly)
        said += int((np.linalg.norm(truly @ one.pose.unobserved.T, axis=1) > 0.95).sum())
        if one.pose.status is not PoseStatus.OK:
            silent += 1
            continue
        squares += float(observed[:2] @ observed[:2])
        axes += round(float(np.trace(closed[:2, :2])))
        if closed[2, 2] > 0.5:
            turns.append(observed[2])
        far += bool(np.hypot(*observed[:2]) > FAR or abs(observed[2]) > FAR_TURNED)
        if basis.shape[1]:
            scaled = basis.T @ (error * _AXES)
            spread = basis.T @ (_AXES[:, None] * one.pose.covariance * _AXES) @ basis
            nees = float(scaled @ np.linalg.solve(spread, scaled))
            ratio.append(nees / chi2.median(basis.shape[1]))
            share.append(nees / basis.shape[1])
    return Row(
        method,
        len(many),
        1e3 * float(np.sqrt(squares / max(axes, 1))),
        float(np.degrees(np.sqrt(np.mean(np.square(turns))))) if turns else np.nan,
        far / max(len(many) - silent, 1),
        silent / len(many),
        float(np.median(ratio)) if ratio else np.nan,
        float(np.mean(share)) if share else np.nan,
        said / unseen if unseen else 1.0,
        left_open / len(many),
        float(np.median([one.ms for one in many])),
    )


def unobserved(grasp: Grasp, shown: Callable[[Grasp], tuple[Array, Array]]) -> Array:
    """Directions (k, 3) of (x, y, θ · `ANGLE_LENGTH`) of which nothing at all shows, by the true geometry."""
    points, normals = shown(grasp)
    J = np.column_stack((normals, normals[:, 1] * points[:, 0] - normals[:, 0] * points[:, 1]))
    return open_directions(J.T @ J, beyond=100.0)


# -- Soft Bubble -------------------------------------------------------------------------------------------------------


def soft_bubble(width: int = 224, height: int = 171) -> Family:
    """Soft Bubbles with pictures of this size."""

    def opened(hand: Hand, finger: str, indentation: float) -> TactileSensor:
        from drivers.sim.soft_bubble import SimSoftBubble, view_of

        config = TactileConfig.model_validate(
            {"kind": "tactile", "sensor": "soft_bubble", "finger": finger, "indentation": indentation}
            | {"width": width, "height": height}
        )
        view_of(config)  # compiled once per installation
        device = SimSoftBubble(f"finger_{finger}", config, hand)
        device.connect()
        return device

    def methods(model: FingerModel, outline: Polygon) -> Sequence[TactilePoseEstimator]:
        from estimation.tactile_pose_icp import CannyIcp
        from estimation.tactile_pose_strips import RidgeStrips

        return CannyIcp(model, outline), RidgeStrips(model, outline)

    return Family(opened, methods, _within_touch, tuple(np.arange(10, 17) * 1e-3))


def _within_touch(grasp: Grasp) -> tuple[Array, Array]:
    """The boundary inside the ellipse in which the unpressed dome would pass through the face."""
    boundary = grasp.outline.boundary(1e-3)
    points = se2.transform(grasp.X_ee_go, boundary.points)
    low = (DOME.top - grasp.indentation) / DOME.top
    # the dome's long axis is y of the finger
    inside = (points[:, 0] / DOME.b) ** 2 + (points[:, 1] / DOME.a) ** 2 < 1 - low**2
    return points[inside], se2.rotate(grasp.X_ee_go[2], boundary.normals[inside])


FAMILIES: dict[str, Family] = {"soft_bubble": soft_bubble(), "soft_bubble 640×480": soft_bubble(640, 480)}


def table(rows: Sequence[Row]) -> str:
    """The rows as text."""
    names = ("n", "mm", "deg", "far %", "silent %", "NEES~", "NEES/d", "flagged %", "open", "ms")
    lines = [f"{'method':<28}" + "".join(f"{name:>10}" for name in names)]
    for r in rows:
        shares = (100 * r.far, 100 * r.silent, r.nees_median, r.nees_mean, 100 * r.flagged, r.open, r.ms)
        figures = (r.rms_mm, r.rms_deg, *shares)
        lines.append(f"{r.method:<28}{r.grasps:>10}" + "".join(f"{figure:>10.3g}" for figure in figures))
    return "\n".join(lines)


def alone(estimate: Estimate, finger: int) -> Estimate:
    """The same grasp by one finger alone."""
    return replace(estimate, pose=estimate.fingers[finger])
