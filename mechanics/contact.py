"""Point contacts of planar bodies: contact frames, Jacobians, weight, and the mode that a relative motion means.

Normals point into the body acted on; the tangent and the modes follow the convention of `mechanics.friction`.
"""

from __future__ import annotations

from mechanics._shapes import Array, load
from mechanics.friction import Mode, tangent


def frame(normal: Array) -> Array:
    """Return (..., 2, 2) with columns (n, t): takes (f_n, f_t) to the axes of W.

    Orthogonal and left-handed, since t is n turned by −90°. ``normal`` (..., 2) is of unit length, in W.
    """
    xp, normal = load("frame", normal=(normal, (2,)))
    return xp.stack([normal, tangent(normal)], axis=-1)


def force_in_world(normal: Array, force: Array) -> Array:
    """Return the contact force (..., 2) [N] in the axes of W from ``force`` = (f_n, f_t) (..., 2)."""
    _, normal, force = load("force_in_world", normal=(normal, (2,)), force=(force, (2,)))
    return force[..., :1] * normal + force[..., 1:] * tangent(normal)


def jacobian(normal: Array, p_BoC_W: Array) -> Array:
    """Return J (..., 2, 3): a body's twist (vx, vy, ω) about Bo in axes of W → velocity (n, t) of its point C.

    Jᵀ takes the contact force (f_n, f_t) on the body to its wrench about Bo, axes of W. ``p_BoC_W`` (..., 2) [m].
    """
    xp, normal, p_BoC_W = load("jacobian", normal=(normal, (2,)), p_BoC_W=(p_BoC_W, (2,)))
    x, y = p_BoC_W[..., 0], p_BoC_W[..., 1]
    rows = [
        xp.stack([axis[..., 0], axis[..., 1], x * axis[..., 1] - y * axis[..., 0]], axis=-1)
        for axis in (normal, tangent(normal))
    ]
    return xp.stack(rows, axis=-2)


def gravity_wrench(mass: Array, p_BoBcm_W: Array, gravity: Array) -> Array:
    """Return the weight's wrench (..., 3) about Bo, axes of W: ``mass`` (...) [kg], ``gravity`` (...) [m/s²] along −y.

    ``p_BoBcm_W`` (..., 2) [m] leads from Bo to the centre of mass, axes of W.
    """
    xp, mass, p_BoBcm_W, gravity = load(
        "gravity_wrench", mass=(mass, ()), p_BoBcm_W=(p_BoBcm_W, (2,)), gravity=(gravity, ())
    )
    weight = mass * gravity
    return xp.stack([xp.zeros_like(weight), -weight, -p_BoBcm_W[..., 0] * weight], axis=-1)


def mode_of_motion(tangential_velocity_of_body: float, tolerance: float = 0.0) -> Mode:
    """Return the mode of a closed contact whose acted-on body moves at this speed [m/s] along t over the other body.

    A body that moves along +t sees the other move along −t: ``slip-``. Speeds up to ``tolerance`` stick.
    """
    if tangential_velocity_of_body > tolerance:
        return Mode.SLIP_NEGATIVE
    if tangential_velocity_of_body < -tolerance:
        return Mode.SLIP_POSITIVE
    return Mode.STICK
