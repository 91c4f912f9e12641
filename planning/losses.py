"""The losses of a contact trajectory, each a small function that returns residuals; a loss is Σ w/K residual².

Extrinsic Contact Trajectory Optimization: cone, smooth, contact force and penetration are the paper's four, slack goes
with the paper form, and the barriers are the paper's future work. ``pull`` and ``track`` are ours. Lengths are measured
in millimetres, forces in newtons; an angle becomes a length by a radius of gyration ρ. Every function takes numpy or
torch, with the steps in dimension −2, or −1 where there is one figure per step.

Barriers are −1/10 log(1 − u²), with u from −1 to 1 between the limits: 0 in the middle, +inf outside.
"""

from __future__ import annotations

from typing import Any

from mechanics import se2
from mechanics._shapes import Array, load
from planning.problem import MILLIMETRE, PlanarArm

NO_FORCE = 1e-9
"""ε [N], which keeps the direction of a force of 0 N defined."""


def cone(force: Array) -> Array:
    """Return 1 − f_n/√(f_n² + f_t² + ε²) (...) of object contacts (..., 2): 1 minus the cosine with the normal."""
    xp, force = load("cone", force=(force, (2,)))
    normal, side = force[..., 0], force[..., 1]
    return 1 - normal / xp.sqrt(normal * normal + side * side + NO_FORCE**2)


def pull(force: Array) -> Array:
    """Return min(f_n, 0) (...) [N] of contacts (..., 2): a contact only pushes."""
    xp, force = load("pull", force=(force, (2,)))
    normal = force[..., 0]
    return xp.where(normal > 0, xp.zeros_like(normal), normal)


def contact_force(force: Array, wish: Array) -> Array:
    """Return f_obj − f_wish (..., K, 2) [N]."""
    _, force, wish = load("contact_force", force=(force, (2,)), wish=(wish, (2,)))
    return force - wish


def penetration(angle: Array, limits: Array) -> Array:
    """Return −1/10 log(−φ) (..., K, 2) with φ = (lo − angle, angle − hi) [rad]; +inf outside ``limits`` (K, 2)."""
    xp, angle, limits = load("penetration", angle=(angle, ()), limits=(limits, (2,)))
    room = xp.stack([angle - limits[..., 0], limits[..., 1] - angle], axis=-1)
    inside = room > 0
    return _where_inside(xp, inside, -0.1 * xp.log(xp.where(inside, room, xp.ones_like(room))))


def slack(lacks: Array, rho: float) -> Array:
    """Return (s_x, s_y, s_τ/ρ_go) (..., K, 3) [N]: what the grasped object's balance lacks, about the grasp centre."""
    _, lacks, size = load("slack", lacks=(lacks, (3,)), size=((1.0, 1.0, rho), (3,)))
    return lacks / size


def track(angle: Array, travel: Array, nominal_angle: Array, nominal_travel: Array, rho: float) -> Array:
    """Return (ρ_go (angle − angle*), travel − travel*) (..., K, 2) [mm]."""
    xp, angle, travel, nominal_angle, nominal_travel = load(
        "track",
        angle=(angle, ()),
        travel=(travel, ()),
        nominal_angle=(nominal_angle, ()),
        nominal_travel=(nominal_travel, ()),
    )
    return xp.stack([rho * (angle - nominal_angle), travel - nominal_travel], axis=-1) / MILLIMETRE


def smooth(go: Array, rho: float) -> Array:
    """Return (Δx, Δy, ρ_go Δθ) (..., K−1, 3) [mm] of the poses ``go`` (..., K, 3)."""
    _, go, size = load("smooth", go=(go, (3,)), size=((1.0, 1.0, rho), (3,)))
    return (go[..., 1:, :] - go[..., :-1, :]) * size[..., 1:, :] / MILLIMETRE


def barrier(squared: Array) -> Array:
    """Return −1/10 log(1 − u²) from u² (...); +inf from u² = 1 on, and where u² is no number."""
    xp, squared = load("barrier", squared=(squared, ()))
    inside = squared < 1
    return _where_inside(xp, inside, -0.1 * xp.log1p(-xp.where(inside, squared, xp.zeros_like(squared))))


def within(q: Array, limits: Array) -> Array:
    """Return the barrier (..., n) of ``q`` (..., n) between the ``limits`` (n, 2)."""
    _, q, lo, hi = load("within", q=(q, ()), lo=(limits[..., 0], ()), hi=(limits[..., 1], ()))
    return barrier(((q - (lo + hi) / 2) / ((hi - lo) / 2)) ** 2)


def workspace(ee: Array, limits: Array) -> Array:
    """Return the barrier (..., K, 3) of X_W_ee between ``limits`` (3, 2) [m, m, rad]."""
    return within(ee, limits)


def joints(ee: Array, arm: PlanarArm) -> Array:
    """Return the barrier (..., K, 3) of the joints of an arm whose tool is at X_W_ee; +inf out of its reach."""
    xp, ee = load("joints", ee=(ee, (3,)))
    readings, reachable = joint_readings(arm, ee)
    return _where_inside(xp, reachable[..., None], within(readings, arm.limits))


def sensor(wrench: Array, force: float | None, torque: float | None) -> Array:
    """Return the barrier (..., K, r) of the sensor's ``wrench`` (..., K, 3), about the grasp centre: u² = |f|²/F² and
    τ²/T², in this order, without what has no limit."""
    xp, wrench = load("sensor", wrench=(wrench, (3,)))
    squares = []
    if force is not None:
        squares.append((wrench[..., 0] ** 2 + wrench[..., 1] ** 2) / force**2)
    if torque is not None:
        squares.append((wrench[..., 2] / torque) ** 2)
    return barrier(xp.stack(squares, axis=-1)) if squares else wrench[..., :0]


def joint_readings(arm: PlanarArm, ee: Array) -> tuple[Array, Array]:
    """Return the joints (..., 3) [rad] that put the tool at X_W_ee (..., 3), and whether (...) the arm reaches there.

    The wrist is at o_ee − R(θ_ee) tool. By the law of cosines the elbow bends by acos((r² − a² − b²)/2ab), the shoulder
    looks at the wrist less the angle between it and the upper arm, and the wrist makes up for the rest; each joint is
    counter-clockwise from ``zero``. Of the readings that mean the same pose it is the one nearest to the middle of the
    joint's limits. Out of reach the readings mean nothing, but are finite.
    """
    a, b = arm.upper, arm.fore
    xp, ee, base, bent, zero, middle = load(
        "joint_readings",
        ee=(ee, (3,)),
        base=(arm.base, (2,)),
        bent=((a, b), (2,)),
        zero=(arm.zero, (3,)),
        middle=(arm.limits.mean(axis=1), (3,)),
    )
    r = ee[..., :2] - se2.rotate(ee[..., 2], arm.tool) - base
    cosine = ((r * r).sum(-1) - a * a - b * b) / (2 * a * b)
    reachable = abs(cosine) < 1
    r = xp.where(reachable[..., None], r, bent)
    cosine = xp.where(reachable, cosine, xp.zeros_like(cosine))
    elbow = arm.elbow * xp.acos(cosine)
    shoulder = xp.atan2(r[..., 1], r[..., 0]) - xp.atan2(b * xp.sin(elbow), a + b * cosine)
    bend = xp.stack([shoulder, elbow, ee[..., 2] - shoulder - elbow], axis=-1)
    return middle + se2.wrap(bend + zero - middle), reachable


def _where_inside(xp: Any, inside: Array, value: Array) -> Array:
    """Return ``value`` where ``inside``, else +inf."""
    return xp.where(inside, value, xp.full_like(value, xp.inf))
