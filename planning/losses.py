"""The losses of a contact trajectory, each a small function that returns residuals; a loss is Σ w/K residual².

Extrinsic Contact Trajectory Optimization: cone, smooth, contact force and penetration are the paper's four, slack goes
with the paper form, and the barriers are the paper's future work. ``pull`` and ``track`` are ours. Lengths are measured
in millimetres, forces in newtons; an angle becomes a length by a radius of gyration ρ. All arrays are torch tensors
with the steps in dimension −2, or −1 where there is one figure per step.

Barriers are −1/10 log(1 − u²), with u from −1 to 1 between the limits: 0 in the middle, +inf outside.
"""

from __future__ import annotations

import numpy as np
import torch

from mechanics import se2
from planning.problem import MILLIMETRE, PlanarArm

NO_FORCE = 1e-9
"""ε [N], which keeps the direction of a force of 0 N defined."""


def cone(force: torch.Tensor) -> torch.Tensor:
    """Return 1 − f_n/√(f_n² + f_t² + ε²) (...) of object contacts (..., 2): 1 minus the cosine with the normal."""
    normal, side = force[..., 0], force[..., 1]
    return 1 - normal / (normal * normal + side * side + NO_FORCE**2).sqrt()


def pull(force: torch.Tensor) -> torch.Tensor:
    """Return min(f_n, 0) (...) [N] of contacts (..., 2): a contact only pushes."""
    return force[..., 0].clamp(max=0.0)


def contact_force(force: torch.Tensor, wish: torch.Tensor) -> torch.Tensor:
    """Return f_obj − f_wish (..., K, 2) [N]."""
    return force - wish


def penetration(angle: torch.Tensor, limits: torch.Tensor) -> torch.Tensor:
    """Return −1/10 log(−φ) (..., K, 2) with φ = (lo − angle, angle − hi) [rad]; +inf outside ``limits`` (K, 2)."""
    room = torch.stack([angle - limits[..., 0], limits[..., 1] - angle], dim=-1)
    inside = room > 0
    return torch.where(inside, -0.1 * torch.where(inside, room, 1.0).log(), torch.inf)


def slack(lacks: torch.Tensor, rho: float) -> torch.Tensor:
    """Return (s_x, s_y, s_τ/ρ_go) (..., K, 3) [N]: what the grasped object's balance lacks, about the grasp centre."""
    return lacks / lacks.new_tensor([1.0, 1.0, rho])


def track(
    angle: torch.Tensor, travel: torch.Tensor, nominal_angle: torch.Tensor, nominal_travel: torch.Tensor, rho: float
) -> torch.Tensor:
    """Return (ρ_go (angle − angle*), travel − travel*) (..., K, 2) [mm]."""
    return torch.stack([rho * (angle - nominal_angle), travel - nominal_travel], dim=-1) / MILLIMETRE


def smooth(go: torch.Tensor, rho: float) -> torch.Tensor:
    """Return (Δx, Δy, ρ_go Δθ) (..., K−1, 3) [mm] of the poses ``go`` (..., K, 3)."""
    return go.diff(dim=-2) * go.new_tensor([1.0, 1.0, rho]) / MILLIMETRE


def barrier(squared: torch.Tensor) -> torch.Tensor:
    """Return −1/10 log(1 − u²) from u² (...); +inf from u² = 1 on, and where u² is no number."""
    inside = squared < 1
    return torch.where(inside, -0.1 * torch.log1p(-torch.where(inside, squared, 0.0)), torch.inf)


def within(q: torch.Tensor, limits: torch.Tensor) -> torch.Tensor:
    """Return the barrier (..., n) of ``q`` (..., n) between the ``limits`` (n, 2)."""
    lo, hi = limits[..., 0], limits[..., 1]
    return barrier(((q - (lo + hi) / 2) / ((hi - lo) / 2)) ** 2)


def workspace(ee: torch.Tensor, limits: torch.Tensor) -> torch.Tensor:
    """Return the barrier (..., K, 3) of X_W_ee between ``limits`` (3, 2) [m, m, rad]."""
    return within(ee, limits)


def joints(ee: torch.Tensor, arm: PlanarArm) -> torch.Tensor:
    """Return the barrier (..., K, 3) of the joints of an arm whose tool is at X_W_ee; +inf out of its reach."""
    readings, reachable = joint_readings(arm, ee)
    held = within(readings, ee.new_tensor(np.array(arm.limits)))
    return torch.where(reachable[..., None], held, torch.inf)


def sensor(wrench: torch.Tensor, force: float | None, torque: float | None) -> torch.Tensor:
    """Return the barrier (..., K, r) of the sensor's ``wrench`` (..., K, 3), about the grasp centre: u² = |f|²/F² and
    τ²/T², in this order, without what has no limit."""
    squares = []
    if force is not None:
        squares.append((wrench[..., 0] ** 2 + wrench[..., 1] ** 2) / force**2)
    if torque is not None:
        squares.append((wrench[..., 2] / torque) ** 2)
    return barrier(torch.stack(squares, dim=-1)) if squares else wrench[..., :0]


def joint_readings(arm: PlanarArm, ee: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the joints (..., 3) [rad] that put the tool at X_W_ee (..., 3), and whether (...) the arm reaches there.

    The wrist is at o_ee − R(θ_ee) tool. By the law of cosines the elbow bends by acos((r² − a² − b²)/2ab), the shoulder
    looks at the wrist less the angle between it and the upper arm, and the wrist makes up for the rest; each joint is
    counter-clockwise from ``zero``. Of the readings that mean the same pose it is the one nearest to the middle of the
    joint's limits. Out of reach the readings mean nothing, but are finite.
    """
    a, b = arm.upper, arm.fore
    r = ee[..., :2] - se2.rotate(ee[..., 2], ee.new_tensor(np.array(arm.tool))) - ee.new_tensor(np.array(arm.base))
    cosine = ((r * r).sum(-1) - a * a - b * b) / (2 * a * b)
    reachable = cosine.abs() < 1
    r = torch.where(reachable[..., None], r, ee.new_tensor([a, b]))
    cosine = torch.where(reachable, cosine, 0.0)
    elbow = arm.elbow * cosine.acos()
    shoulder = torch.atan2(r[..., 1], r[..., 0]) - torch.atan2(b * elbow.sin(), a + b * cosine)
    bend = torch.stack([shoulder, elbow, ee[..., 2] - shoulder - elbow], dim=-1)
    middle = ee.new_tensor(np.array(arm.limits).mean(axis=1))
    return middle + se2.wrap(bend + ee.new_tensor(np.array(arm.zero)) - middle), reachable
