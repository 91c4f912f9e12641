"""The compliant finger as a linear spring between the end-effector and the object it holds: w = K x.

Tactile Elasticity Model, eq. (1), after SEED. x = (x, y, θ) [m, m, rad] is the pose of ``ee`` relative to where it is
at zero wrench, in ``gocf``; w = (fx, fy, τ) is the wrench *of the sensor on the grasped object*, about gocf's origin
(the grasp centre on the object), in gocf. x is used as a pose as it stands (small-angle coordinates), not through the
SE(2) exponential: X_W_ee = X_W_go ∘ X_go_gocf ∘ x, and at zero wrench ``ee`` and ``gocf`` coincide.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from array_api_compat import is_torch_array
from numpy.typing import NDArray

from mechanics import se2
from mechanics._shapes import Array, load
from mechanics.wrench import rotated


def scaled(K_printed: Array, rho: float) -> Array:
    """Return K in SI units [N/m, N, N·m/rad], S K S with S = diag(1, 1, ρ): (..., 3, 3) → (..., 3, 3).

    ``rho`` [m] is the length by which the angle was scaled when ``K_printed`` [N/m throughout] was identified. It
    belongs to the sensor and never follows the object held.
    """
    if not rho > 0:
        raise ValueError(f"scaled: rho: expected a positive length [m], received {rho}")
    xp, K_printed, s = load("scaled", K_printed=(K_printed, (3, 3)), s=((1.0, 1.0, rho), (3,)))
    return xp.expand_dims(s, axis=-1) * K_printed * xp.expand_dims(s, axis=-2)


def check_positive_definite(K: Array) -> None:
    """Raise ValueError, which states the smallest eigenvalue, unless K (..., 3, 3) is symmetric positive definite."""
    _, K = load("check_positive_definite", K=(K, (3, 3)))
    values: NDArray[np.float64] = _numpy(K)
    if not np.isfinite(values).all():
        raise ValueError(f"stiffness: expected finite numbers, received {values.tolist()}")
    asymmetry = np.abs(values - np.swapaxes(values, -1, -2)).max()
    if asymmetry > 1e-6 * np.abs(values).max():
        raise ValueError(f"stiffness: expected a symmetric matrix, received one that is off by {asymmetry:.3g}")
    smallest = float(np.linalg.eigvalsh(values).min())
    if smallest <= 0:
        raise ValueError(
            f"stiffness: expected a positive definite matrix, received one with smallest eigenvalue {smallest:.6g};"
            " it is inverted to turn wrenches into displacements"
        )


@dataclass(frozen=True, eq=False)
class Elasticity:
    """A finger of stiffness K (..., 3, 3) [N/m, N, N·m/rad], symmetric positive definite, in gocf.

    Methods take numpy or torch, any leading dimensions; torch differentiates through poses, wrenches and K.
    """

    stiffness: Array

    def __post_init__(self) -> None:
        _, K = load("Elasticity", stiffness=(self.stiffness, (3, 3)))
        check_positive_definite(K)
        if not is_torch_array(K):
            K = np.array(K)
            K.setflags(write=False)
        object.__setattr__(self, "stiffness", K)

    def wrench(self, x: Array) -> Array:
        """Return w = K x (..., 3) in gocf, of the sensor on the object, for ee's displacement ``x`` (..., 3)."""
        _, K, x = load("Elasticity.wrench", stiffness=(self.stiffness, (3, 3)), x=(x, (3,)))
        return (K @ x[..., None])[..., 0]

    def displacement(self, w: Array) -> Array:
        """Return x = K⁻¹ w (..., 3): the displacement of ee in gocf that makes the wrench ``w`` (..., 3) in gocf."""
        xp, K, w = load("Elasticity.displacement", stiffness=(self.stiffness, (3, 3)), w=(w, (3,)))
        return xp.linalg.solve(K, w[..., None])[..., 0]

    def ee_pose(self, X_W_go: Array, X_go_gocf: Array, w_W: Array) -> Array:
        """Return X_W_ee (..., 3), where the end-effector must be to put ``w_W`` on an object at ``X_W_go``.

        ``w_W`` (..., 3): of the sensor on the object, about the grasp centre, axes of W.
        """
        X_W_gocf = se2.compose(X_W_go, X_go_gocf)
        return se2.compose(X_W_gocf, self.displacement(rotated(w_W, -X_W_gocf[..., 2])))

    def wrench_at(self, X_W_go: Array, X_go_gocf: Array, X_W_ee: Array) -> Array:
        """Return w_W (..., 3), of the sensor on the object about the grasp centre in axes of W, from the two poses."""
        X_W_gocf = se2.compose(X_W_go, X_go_gocf)
        return rotated(self.wrench(se2.between(X_W_gocf, X_W_ee)), X_W_gocf[..., 2])

    def go_pose(self, X_W_ee: Array, X_go_gocf: Array, w_W: Array) -> Array:
        """Return X_W_go (..., 3), where the object is when the end-effector at ``X_W_ee`` puts ``w_W`` on it.

        The inverse of `ee_pose`. The wrench turns with the object, so its angle solves a scalar equation, by Newton
        from the end-effector's angle. Raises ValueError when there is no solution near it: a wrench far beyond what
        the finger can carry.
        """
        xp, X_W_ee, X_go_gocf, w_W, K = load(
            "Elasticity.go_pose",
            X_W_ee=(X_W_ee, (3,)),
            X_go_gocf=(X_go_gocf, (3,)),
            w_W=(w_W, (3,)),
            stiffness=(self.stiffness, (3, 3)),
        )
        # φ (gocf's angle) is the root of φ + c · w(φ) − θ_ee, where c is the angle's row of K⁻¹.
        unit = xp.zeros_like(w_W) + xp.asarray([0.0, 0.0, 1.0], dtype=w_W.dtype, device=w_W.device)
        c = xp.linalg.solve(K, unit[..., None])[..., 0]

        def error_and_slope(phi: Array, c: Array, w_W: Array, theta: Array) -> tuple[Array, Array]:
            w = rotated(w_W, -phi)
            error = phi + xp.sum(c * w, axis=-1) - theta
            return error, 1 + c[..., 0] * w[..., 1] - c[..., 1] * w[..., 0]

        fixed = [_detached(value) for value in (c, w_W, X_W_ee[..., 2])]
        phi = fixed[2]
        for _ in range(50):
            error, slope = error_and_slope(phi, *fixed)
            if not bool(xp.all(slope > 0)):
                break
            phi = phi - error / slope
            if bool(xp.all(xp.abs(error) <= 1e-14 * (1 + xp.abs(phi)))):
                # one more step from the root: nothing in value, the implicit function's derivative in torch
                error, slope = error_and_slope(phi, c, w_W, X_W_ee[..., 2])
                phi = phi - error / _detached(slope)
                x = self.displacement(rotated(w_W, -phi))
                return se2.compose(se2.compose(X_W_ee, se2.inverse(x)), se2.inverse(X_go_gocf))
        raise ValueError(
            "Elasticity.go_pose: w_W: expected a wrench that the finger can carry, received one that turns the object"
            f" without limit (largest force {float(xp.max(xp.abs(w_W[..., :2]))):.3g} N)"
        )


def _detached(value: Array) -> Array:
    return value.detach() if is_torch_array(value) else value


def _numpy(value: Array) -> NDArray[np.float64]:
    return np.asarray(value.detach().cpu() if is_torch_array(value) else value, dtype=np.float64)
