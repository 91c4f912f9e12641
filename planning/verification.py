"""Whether a result is what was asked for: every balance and every cone again, from the forces and poses alone.

Optimisers minimise a loss in which the cone of the go's contact with the extrinsic object, and in the paper form the
go's balance, are terms like others. A plan must not be taken for good because its loss is small.
"""

from __future__ import annotations

import numpy as np

from mechanics import se2
from mechanics.friction import Mode, cone_margin
from mechanics.readings import Array
from planning.evaluation import Evaluation
from planning.problem import ANGLE, Form, Problem

EXACT = 1e-6
"""What a balance or a hard cone may miss, relative to the forces of its step."""

CONE_MISS = 1e-3
"""[N] by which the go's force on the extrinsic object may leave its cone."""

WISH_MISS = 0.1
"""[N] by which the go's force may miss the wish."""

SLACK_MISS = 0.05
"""[N] that the go's balance may lack in the paper form."""


def verify(problem: Problem, z: Array, found: Evaluation) -> list[str]:
    """Return what a result misses, in lines for a person: none where it is what was asked for."""
    lines: list[str] = []
    forces, n = found.forces, len(problem.contacts)
    scale = 1.0 + np.abs(forces).max(axis=(1, 2))
    for c, name in enumerate(found.names):
        allowed = CONE_MISS if c < n and problem.eo_body is not None else EXACT * scale
        modes = np.array([row[c].slip_sign for row in found.modes])
        free = np.array([row[c] is Mode.FREE for row in found.modes])
        f_n, f_t = forces[:, c, 0], forces[:, c, 1]
        off = np.where(modes != 0, np.maximum(np.abs(f_t - modes * found.mu[c] * f_n), -f_n), 0.0)
        off = np.where((modes == 0) & ~free, -np.asarray(cone_margin(forces[:, c], found.mu[c])), off)
        off = np.where(free, np.hypot(f_n, f_t), off)
        _tell(lines, off - allowed, f"{name} leaves its cone by {{:.3g}} N", off)
    if problem.eo_body is not None:
        lacks = _eo_residual(problem, found)
        _tell(lines, lacks - EXACT * scale, "the extrinsic object is out of balance by {:.3g} N", lacks)
    slack = _go_residual(problem, found)
    _tell(lines, slack - (SLACK_MISS if problem.form is Form.PAPER else EXACT * scale), "the go lacks {:.3g} N", slack)
    wish = np.sum([contact.wish for contact in problem.contacts], axis=0)
    missed = np.linalg.norm(forces[:, :n].sum(axis=1) - wish, axis=1)
    _tell(lines, missed - WISH_MISS, "the go's force misses the wish by {:.3g} N", missed)
    y = z * problem.scale
    outside = np.maximum(problem.angle_limits[:, 0] - y[:, ANGLE], y[:, ANGLE] - problem.angle_limits[:, 1])
    _tell(lines, outside, "the bodies go into each other by {:.3g}°", np.rad2deg(outside))
    return lines


def _tell(lines: list[str], over: Array, text: str, figure: Array) -> None:
    """Add the worst step's line where ``over`` (K,) is positive."""
    k = int(np.argmax(over))
    if over[k] > 0:
        lines.append(f"step {k}: {text.format(float(figure[k]))}")


def _world_forces(found: Evaluation) -> Array:
    """The contact forces (K, C, 2) in W, each on the body acted on."""
    n = found.normals
    t = np.stack([n[..., 1], -n[..., 0]], axis=-1)
    return found.forces[..., :1] * n + found.forces[..., 1:] * t


def _eo_residual(problem: Problem, found: Evaluation) -> Array:
    """What balances of the eo lack (K,) [N], moments divided by its radius of gyration."""
    assert problem.eo_body is not None
    f = _world_forces(found)
    arm = found.points - found.eo[:, None, :2]
    force = f.sum(axis=1) - np.array([0.0, problem.eo_body.mass * problem.gravity])
    moment = (arm[..., 0] * f[..., 1] - arm[..., 1] * f[..., 0]).sum(axis=1)
    return np.maximum(np.linalg.norm(force, axis=1), np.abs(moment) / problem.eo_body.rho)


def _go_residual(problem: Problem, found: Evaluation) -> Array:
    """What balances of the go lack (K,) [N], moments divided by its radius of gyration."""
    n = len(problem.contacts)
    f = _world_forces(found)[:, :n] * (1.0 if problem.eo_body is None else -1.0)
    grasp = se2.transform(found.go, problem.grasp[:2])
    arm = found.points[:, :n] - grasp[:, None]
    weight = np.array([0.0, -problem.go_body.mass * problem.gravity])
    to_com = found.go[:, :2] - grasp
    force = found.wrench[:, :2] + weight + f.sum(axis=1)
    moment = found.wrench[:, 2] + to_com[:, 0] * weight[1]
    moment = moment + (arm[..., 0] * f[..., 1] - arm[..., 1] * f[..., 0]).sum(axis=1)
    return np.maximum(np.linalg.norm(force, axis=1), np.abs(moment) / problem.go_body.rho)
