"""The environment's wrench on the grasped object, whichever sensor it comes from.

The contact program explains what the *environment* does to the go. In P1 w_ext is what the *sensor* does to it, and
the balance of the go is w_ext + τ_g,go + w_env = 0 (design §9), so w_env = −(w_ext + τ_g,go). `environment_wrench` is
the one place where this sign is.

Two sources, interchangeable as the paper says, and joined by `fuse`: a wrist force/torque sensor, and the compliance
w_ext = K x with x from a tactile image. Both are kept in the information form: what an image does not show of x has
infinite variance, which is a zero of the information matrix, and no number has to stand for it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from estimation.force_torque import FreeAirLoad
from estimation.tactile_pose import ANGLE_LENGTH
from mechanics import se2
from mechanics import wrench as wrenches
from mechanics.elasticity import Elasticity
from mechanics.readings import Array

#: eigenvalues of an information matrix in force units below this share of the largest say nothing
_NOTHING = 1e-12


@dataclass(frozen=True, eq=False)
class EnvironmentWrench:
    """What the environment does to the go: ``wrench`` (..., 3) [N, N, N·m] about ``about`` (2,) [m], all in go.

    ``information`` (3, 3) or (..., 3, 3) is the inverse covariance of the wrench's error; singular where a direction
    is not observed, and there the wrench's figures mean nothing.
    """

    wrench: Array
    information: Array
    about: Array

    def __post_init__(self) -> None:
        shapes = np.shape(self.wrench), np.shape(self.information), np.shape(self.about)
        leading = shapes[0][:-1]
        if shapes[0][-1:] != (3,) or shapes[1] not in ((3, 3), (*leading, 3, 3)) or shapes[2] != (2,):
            raise ValueError(
                "environment wrench: expected wrench (..., 3), information (3, 3) or (..., 3, 3), about (2,), received "
                + ", ".join(map(str, shapes))
            )

    @classmethod
    def of(cls, wrench: ArrayLike, covariance: ArrayLike, about: ArrayLike = (0.0, 0.0)) -> EnvironmentWrench:
        """From a regular covariance (3, 3). Raises ValueError for one that is not positive definite."""
        covariance = np.asarray(covariance, float)
        if not (np.linalg.eigvalsh(covariance) > 0).all():
            raise ValueError("environment wrench: its covariance is not positive definite; every sensor has noise")
        return cls(np.asarray(wrench, float), np.linalg.inv(covariance), np.asarray(about, float))

    def moved_to(self, about: ArrayLike) -> EnvironmentWrench:
        """The same wrench about another point of the go."""
        about = np.asarray(about, float)
        back = _move(about, self.about)
        return EnvironmentWrench(
            wrenches.about(self.wrench, self.about, about), back.T @ self.information @ back, about
        )


def environment_wrench(w_ext: Array, X_W_go: Array, p_W: Array, load: FreeAirLoad) -> Array:
    """w_env = −(w_ext + τ_g,go), (..., 3), of the environment on the go about ``p_W``, axes of W.

    ``w_ext`` (..., 3) is of the sensor on the go about ``p_W`` (2,), axes of W; ``load`` is the go's weight. A go
    that hangs free gives zero.
    """
    return load.wrench_on_go(X_W_go, p_W) - np.asarray(w_ext, float)


def wrist_covariance(covariance_s: Array, X_W_s: Array, p_W: Array) -> Array:
    """Covariance (3, 3) of the wrench about ``p_W``, axes of W, from that of a planar reading of the sensor.

    ``covariance_s`` (3, 3) is of (fx, fy, τ) in the sensor's frame at ``X_W_s`` (3,). The noise of the force times
    the lever is noise of the torque, and correlated with it: at 200 mm, 0.05 N make 10 N·mm out of 2.
    """
    A = _columns(lambda w: wrenches.about(wrenches.rotated(w, X_W_s[2]), X_W_s[:2], p_W))
    return A @ covariance_s @ A.T


def from_force_torque(
    w_ext: Array, covariance: Array, X_W_go: Array, p_W: Array, load: FreeAirLoad
) -> EnvironmentWrench:
    """From the wrist sensor: ``w_ext`` (..., 3) and its ``covariance`` (3, 3) about ``p_W`` (2,), axes of W.

    `WristSensor.wrench_on_go` gives the first, `wrist_covariance` the second, over the number of readings in a mean.
    """
    information = np.asarray(np.linalg.inv(covariance), np.float64)
    return _seen_by_go(environment_wrench(w_ext, X_W_go, p_W, load), information, X_W_go, p_W)


def from_elasticity(
    elasticity: Elasticity,
    X_ee_go: Array,
    information: Array,
    X_go_gocf: Array,
    X_W_go: Array,
    load: FreeAirLoad,
    unobserved: Array | None = None,
) -> EnvironmentWrench:
    """From the compliance: w_ext = K x, x the pose of ee in gocf, about the grasp centre.

    ``X_ee_go`` (3,) is a tactile pose, ``information`` (3, 3) what the image says of its error Δ (left, about ee:
    `tactile_pose`), ``unobserved`` (k, 3) the orthonormal directions of (x, y, θ · ANGLE_LENGTH) that it leaves
    open: of these the wrench is told nothing. The errors of K are not in it: add them by `loosened`.
    """
    x = se2.inverse(se2.compose(X_ee_go, X_go_gocf))
    # x_true = x ∘ Δ⁻¹: to first order an error of −R(θ_x) Δ, and the sign drops out of a quadratic form
    R = np.eye(3)
    R[:2, :2] = se2.rotation(x[2])
    K_inv = np.linalg.inv(elasticity.stiffness)
    to_delta = R.T @ K_inv
    w_gocf = elasticity.wrench(x)
    in_force = to_delta.T @ _without(information, unobserved) @ to_delta
    X_W_gocf = se2.compose(X_W_go, X_go_gocf)
    turn = np.eye(3)
    turn[:2, :2] = se2.rotation(X_W_gocf[2])
    w_W, p_W = wrenches.rotated(w_gocf, X_W_gocf[2]), X_W_gocf[:2]
    return _seen_by_go(environment_wrench(w_W, X_W_go, p_W, load), turn @ in_force @ turn.T, X_W_go, p_W)


def fuse(first: EnvironmentWrench, *others: EnvironmentWrench) -> EnvironmentWrench:
    """One wrench, about the first one's point, from independent sources: informations add.

    In a direction that none of them observes the wrench is the smallest that agrees with the rest.
    """
    moved = [first, *(other.moved_to(first.about) for other in others)]
    total = np.sum([m.information for m in moved], axis=0)
    pulled = np.sum([(m.information @ m.wrench[..., None])[..., 0] for m in moved], axis=0)
    # torque in N by a length of a hand's breadth, so that "small" has one meaning for both
    scale = np.array([1.0, 1.0, 10.0])
    values, vectors = np.linalg.eigh(total / (scale[:, None] * scale))
    inverse = np.where(values > _NOTHING * values.max(), 1 / np.where(values > 0, values, 1.0), 0.0)
    covariance = (vectors * inverse) @ vectors.T / (scale[:, None] * scale)
    return EnvironmentWrench(pulled @ covariance, total, first.about)


def loosened(wrench: EnvironmentWrench, covariance: Array) -> EnvironmentWrench:
    """The same wrench with one more independent error of regular ``covariance`` (3, 3), about the same point.

    For what does not average out: the rest of a tare's drift, the error of K. (H⁻¹ + Q)⁻¹ = H − H (H + Q⁻¹)⁻¹ H
    holds for a singular H too.
    """
    H = wrench.information
    less = H @ np.linalg.solve(H + np.linalg.inv(covariance), H)
    return EnvironmentWrench(wrench.wrench, H - (less + less.T) / 2, wrench.about)


def _without(information: Array, directions: Array | None) -> Array:
    """``information`` (3, 3) with nothing left along ``directions`` (k, 3) of (x, y, θ · ANGLE_LENGTH)."""
    if directions is None or not len(directions):
        return information
    scale = np.array([1.0, 1.0, ANGLE_LENGTH])
    keep = np.eye(3) - directions.T @ directions
    return scale[:, None] * (keep @ (information / (scale[:, None] * scale)) @ keep) * scale


def _seen_by_go(w_W: Array, information_W: Array, X_W_go: Array, p_W: Array) -> EnvironmentWrench:
    """From about ``p_W`` in axes of W to about the same point in axes of go."""
    R = np.eye(3)
    R[:2, :2] = se2.rotation(X_W_go[2])
    about = se2.transform(se2.inverse(X_W_go), np.asarray(p_W, float))
    return EnvironmentWrench(wrenches.rotated(w_W, -X_W_go[2]), R.T @ information_W @ R, about)


def _move(p_from: Array, p_to: Array) -> Array:
    """The matrix of `wrench.about`."""
    return _columns(lambda w: wrenches.about(w, p_from, p_to))


def _columns(of) -> Array:
    """The matrix (3, 3) of a linear map of wrenches."""
    return of(np.eye(3)).T
