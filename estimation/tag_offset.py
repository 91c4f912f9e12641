"""How a tag sits on its object: X_go_tag, from where the tag is while something else tells where the object is.

Two kinds of sighting tell that. A *touch*: corners of the outline are known to lie on the table, y = 0. One corner
gives one number; an edge that lies flat gives two, the tag's angle in the object and its height above that edge; its
place along the edge takes touches on a corner with the object tilted, or another edge. A *tactile* sighting gives what
the fingers' image gave. What no sighting shows stays as it was believed, and is named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import block_diag

from estimation.errors import FitError
from estimation.tactile_pose import open_directions
from mechanics import se2
from mechanics.readings import Array

_WHAT = "tag offset"
BELIEF = (0.003, 0.003, 0.05)
"""How well a tag is stuck on by hand, 1 sigma of (x, y, θ) [m, m, rad]."""
GROUND = (7e-5, 4e-4)
"""How well the table's tags tell its height and tilt, 1 sigma [m, rad]: four of them, stuck on to 0.1 mm and 0.1°."""
UNOBSERVED_BEYOND = 0.001
"""A direction is unobserved when the sightings alone leave 1 sigma beyond this [m, with θ scaled]: a tag is stuck on
about as well by eye."""
_LEVEL = 1e-4  # m, 1 sigma: how flat the table is and how exact an outline


@dataclass(frozen=True, eq=False)
class Touch:
    """The tag at ``X_T_tag`` (3,) over the table T while the ``corners`` of the outline, by index, lie on the ground.

    ``covariance`` (3, 3) is that of X_T_tag, ``level`` [m] 1 sigma of how well a corner that touches is at y = 0.
    """

    X_T_tag: Array
    corners: tuple[int, ...]
    covariance: Array = field(default_factory=lambda: np.zeros((3, 3)))
    level: float = _LEVEL


@dataclass(frozen=True, eq=False)
class Tactile:
    """The object at ``X_ee_go`` (3,) by touch, with ``information`` (3, 3), while the tag is at ``X_ee_tag`` (3,).

    Both are errors as in `estimation.tactile_pose`: left, about the ee's origin, in its axes. Systematic errors are
    part of them: many sightings of one grasp share them, and count as one.
    """

    X_ee_go: Array
    information: Array
    X_ee_tag: Array
    covariance: Array = field(default_factory=lambda: np.zeros((3, 3)))


@dataclass(frozen=True, slots=True)
class TagOffset:
    """``pose`` X_go_tag (3,) and its ``covariance`` (3, 3), of (x, y, θ), with what was believed before.

    ``information`` (3, 3) is that of the sightings alone; ``unobserved`` (k, 3) are orthonormal directions of
    (x, y, θ · `tactile_pose.ANGLE_LENGTH`), in the object's axes, which they leave open: there the pose is the
    believed one. ``chi_square`` is the misfit over its degrees of freedom.
    """

    pose: Array
    covariance: Array
    information: Array
    unobserved: Array
    chi_square: float


def fit_tag_offset(
    outline: Array,
    sightings: Sequence[Touch | Tactile],
    believed: Array,
    *,
    belief: Sequence[float] = BELIEF,
    ground: tuple[float, float] = GROUND,
) -> TagOffset:
    """X_go_tag from ``sightings`` of a tag on the object of ``outline`` (n, 2) [m], in the object's frame.

    ``believed`` (3,) is where the tag was to be stuck and ``belief`` 1 sigma of how well that was done. ``ground`` is
    1 sigma of the ground's height [m] and tilt [rad] in T, which all touches share.

    Raises FitError for no sighting, numbers that are not finite, a corner that the outline does not have, and
    sightings that contradict each other.
    """
    outline, believed = np.asarray(outline, float), np.asarray(believed, float)
    if not sightings:
        raise FitError(_WHAT, "a touch or a tactile sighting", "none", "Lay an edge of the object on the table.")
    for k, sighting in enumerate(sightings):
        _check(outline, sighting, k)
    prior = np.diag(1 / np.square(belief))
    X, information, cost, rows = believed.copy(), np.zeros((3, 3)), 0.0, 0
    for _ in range(20):
        information, pull, cost, rows = np.zeros((3, 3)), np.zeros(3), 0.0, 0
        for residual, jacobian, weight in _blocks(outline, sightings, X, np.square(ground)):
            information += jacobian.T @ weight @ jacobian
            pull -= jacobian.T @ weight @ residual
            cost += float(residual @ weight @ residual)
            rows += int(np.linalg.matrix_rank(weight))
        off = se2.wrap(X[2] - believed[2])
        step = np.linalg.solve(information + prior, pull - prior @ np.array([*(X[:2] - believed[:2]), off]))
        X = X + step
        if np.abs(step).max() < 1e-12:
            break
    X[2] = se2.wrap(X[2])
    unobserved = open_directions(information, UNOBSERVED_BEYOND)
    chi_square = cost / max(rows - 3 + len(unobserved), 1)
    if chi_square > 50.0:
        raise FitError(
            _WHAT,
            "sightings that agree",
            f"a misfit {chi_square:.0f} times what their sigmas allow",
            "See which corner really touched, and whether the outline is the object's.",
        )
    covariance = np.linalg.inv(information / max(chi_square, 1.0) + prior)
    return TagOffset(X, np.asarray(covariance, np.float64), information, unobserved, chi_square)


def _check(outline: Array, sighting: Touch | Tactile, k: int) -> None:
    if not all(np.isfinite(np.asarray(value, float)).all() for value in vars(sighting).values()):
        raise FitError(_WHAT, "finite numbers", f"NaN in sighting {k}", "Leave it out.")
    if isinstance(sighting, Touch):
        wrong = [i for i in sighting.corners if not 0 <= i < len(outline)]
        if wrong or not sighting.corners:
            raise FitError(
                _WHAT, f"corners 0 to {len(outline) - 1} of the outline", f"{sighting.corners}", f"Correct touch {k}."
            )


def _blocks(
    outline: Array, sightings: Sequence[Touch | Tactile], X: Array, ground: Array
) -> list[tuple[Array, Array, Array]]:
    """Residuals (m,), derivatives (m, 3) by X_go_tag and weights (m, m): one of all touches, one per tactile pose."""
    touches = [_touch(outline[list(t.corners)], t, X) for t in sightings if isinstance(t, Touch)]
    out = [_tactile(t, X) for t in sightings if isinstance(t, Tactile)]
    if touches:
        heights, by_offset, by_ground = (np.concatenate([touch[i] for touch in touches]) for i in range(3))
        own = np.asarray(block_diag(*(touch[3] for touch in touches)), np.float64)
        weight = np.linalg.inv(own + (by_ground * ground) @ by_ground.T)
        out.append((heights, by_offset, np.asarray(weight, np.float64)))
    return out


def _touch(corners: Array, touch: Touch, X: Array) -> tuple[Array, Array, Array, Array]:
    """Heights of ``corners`` (m, 2) over the ground by the tag and the object's angle.

    With them their derivatives by X_go_tag (m, 3) and by the ground's height and tilt (m, 2), and their covariance.
    """
    angle = touch.X_T_tag[2] - X[2]
    c, s = np.cos(angle), np.sin(angle)
    arm = corners - X[:2]
    height = touch.X_T_tag[1] + s * arm[:, 0] + c * arm[:, 1]
    slope = c * arm[:, 0] - s * arm[:, 1]  # by the object's angle
    one = np.ones(len(corners))
    by_offset = np.column_stack((-s * one, -c * one, -slope))
    by_tag = np.column_stack((0 * one, one, slope))
    by_ground = np.column_stack((one, touch.X_T_tag[0] + slope))
    return height, by_offset, by_ground, by_tag @ touch.covariance @ by_tag.T + touch.level**2 * np.eye(len(corners))


def _tactile(sighting: Tactile, X: Array) -> tuple[Array, Array, Array]:
    """Δ with X_ee_tag = Δ ∘ X_ee_go ∘ X_go_tag, about the ee's origin."""
    predicted = se2.compose(sighting.X_ee_go, X)
    delta = se2.compose(sighting.X_ee_tag, se2.inverse(predicted))
    delta = np.array([*delta[:2], se2.wrap(delta[2])])
    c, s = np.cos(sighting.X_ee_go[2]), np.sin(sighting.X_ee_go[2])
    # to first order a step of X moves the tag by that step, seen from the ee's origin
    moved = np.array([[c, -s, predicted[1]], [s, c, -predicted[0]], [0.0, 0.0, 1.0]])
    # (I⁻¹ + Σ)⁻¹, for an information I that may be singular
    weight = np.linalg.solve(np.eye(3) + sighting.information @ sighting.covariance, sighting.information)
    return delta, -moved, (weight + weight.T) / 2
