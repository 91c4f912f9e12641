"""What hangs on the wrist sensor: mass, centre of mass and zero, from readings at rest at several angles in free air.

In the sensor's frame the weight turns as the arm turns and the zero does not. With φ the sensor's angle in W and r the
lever from the sensor to the tool's centre, axes of ee, a reading at rest is

    (fx, fy) = −m g (sin φ, cos φ) + offset,    τ = −g (m r_x cos θ − m r_y sin θ) + offset:

linear in m, m r and the offsets, forces and torque apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtrc

from estimation.errors import FitError, finite_rows
from estimation.force_torque import FreeAirLoad, WristSensor
from mechanics import se2, wrench
from mechanics.contact import gravity_wrench
from mechanics.readings import Array
from mechanics.task_plane import TaskPlane

#: beyond this the angles are too alike: errors of a reading grow by about as much in the mass or the centre
WORST_CONDITION = 100.0
#: three angles fix the torque's unknowns, a fourth reading tells its noise
_READINGS = 4
#: standard errors below which a mass is no mass
_LIGHTEST = 3.0


@dataclass(frozen=True, eq=False)
class ToolFit:
    """An identified tool.

    ``mass`` [kg], ``p_ee_tool`` (2,) [m] its centre of mass in ee, ``offset`` (3,) = (fx, fy, τ) [N, N, N·m] the planar
    reading at no load, in the sensor's frame. ``covariance`` (6, 6) is that of (mass, centre, offset), SI, from the
    residuals; ``condition`` the larger condition number of the two regressions, 1 at best; ``residual_rms`` [N] of the
    forces and [N·m] of the torque.
    """

    mass: float
    p_ee_tool: Array
    offset: Array
    covariance: Array
    condition: float
    residual_rms: tuple[float, float]
    samples: int

    @property
    def standard_errors(self) -> Array:
        """1 sigma (6,) of mass, centre (2) and offset (3)."""
        return np.sqrt(np.diag(self.covariance))

    def sensor(self, X_ee_s: Array, gravity: float = 9.81) -> WristSensor:
        """The wrist sensor at ``X_ee_s`` (3,) that takes this tool and this zero out of its readings."""
        return WristSensor(np.asarray(X_ee_s, float), self.offset, self.mass, self.p_ee_tool, gravity)


def identify_tool(
    readings: ArrayLike,
    X_W_ee: ArrayLike,
    X_ee_s: ArrayLike,
    gravity: float = 9.81,
    load: FreeAirLoad | None = None,
    X_W_go: ArrayLike | None = None,
) -> ToolFit:
    """The tool from ``readings`` (n, 6) of the wrist sensor at rest, see `WrenchReading`, each at ``X_W_ee`` (n, 3).

    ``X_ee_s`` (3,) is the sensor's pose in ee. A ``load`` in the fingers counts with its known weight where it hangs,
    ``X_W_go`` (n, 3). Raises FitError for fewer than four readings, NaN, angles that are too alike, or no tool at all.
    """
    read = TaskPlane().wrench_to_planar(finite_rows("wrist readings", readings, (6,)))
    poses = finite_rows("poses of the end-effector", X_W_ee, (3,), ("x", "y", "θ"))
    if len(read) != len(poses):
        raise FitError("wrist readings", "one for each pose", f"{len(read)} for {len(poses)}", "Pair them by time.")
    if len(read) < _READINGS:
        raise FitError(
            "wrist readings",
            "at least 4, for mass, centre of mass (2), offset (3) and the noise",
            f"{len(read)}",
            "Read at more angles: five over ±45° are plenty.",
        )
    if gravity <= 0:
        raise FitError("gravity", "a positive number [m/s²]", f"{gravity:g}", "Without weight there is no tool to see.")
    at = np.asarray(X_ee_s, float)
    X_W_s = se2.compose(poses, at)
    if load is not None:
        if X_W_go is None:
            raise FitError("poses of the load", "X_W_go (n, 3) with a load", "none", "Say where the object hangs.")
        held = finite_rows("poses of the load", X_W_go, (3,), ("x", "y", "θ"))
        weight = gravity_wrench(load.mass, se2.transform(held, load.p_com) - X_W_s[:, :2], load.gravity)
        read = read - wrench.rotated(weight, -X_W_s[:, 2])
    return _fit(read, poses[:, 2], X_W_s[:, 2], at, gravity)


def _fit(read: Array, theta: Array, phi: Array, X_ee_s: Array, g: float) -> ToolFit:
    n = len(read)
    one, zero = np.ones(n), np.zeros(n)
    along_x = np.stack([-g * np.sin(phi), one, zero], axis=-1)
    along_y = np.stack([-g * np.cos(phi), zero, one], axis=-1)
    force_rows = np.concatenate([along_x, along_y])
    torque_rows = np.stack([-g * np.cos(theta), g * np.sin(theta), one], axis=-1)
    condition = max(_condition(force_rows), _condition(torque_rows))
    if not condition < WORST_CONDITION:
        spread = np.degrees(np.ptp(np.unwrap(np.sort(theta))))
        raise FitError(
            "angles of the end-effector",
            f"three or more that differ (condition below {WORST_CONDITION:g})",
            f"angles within {spread:.3g}° (condition {condition:.3g})",
            "Turn the arm further: θ alone tells the weight from the zero; translations do not.",
        )
    (m, ox, oy), force_cov, force_rms = _regress(force_rows, read[:, :2].T.ravel())
    (mx, my, ot), torque_cov, torque_rms = _regress(torque_rows, read[:, 2])
    if m <= _LIGHTEST * np.sqrt(force_cov[0, 0]):
        raise FitError(
            "tool",
            "a mass above its own error",
            f"{m:.3g} ± {np.sqrt(force_cov[0, 0]):.2g} kg",
            "Check the sign and the axes of the sensor, or that it does not tare between the readings.",
        )
    r = np.array([mx, my]) / m
    # from (m, offset of force; m r, offset of torque) to (m, centre, offset)
    J = np.zeros((6, 6))
    J[0, 0] = J[3, 1] = J[4, 2] = J[5, 5] = 1.0
    J[1:3, 0] = -r / m
    J[1, 3] = J[2, 4] = 1.0 / m
    raw = np.zeros((6, 6))
    raw[:3, :3], raw[3:, 3:] = force_cov, torque_cov
    return ToolFit(
        mass=float(m),
        p_ee_tool=X_ee_s[:2] + r,
        offset=np.array([ox, oy, ot]),
        covariance=J @ raw @ J.T,
        condition=float(condition),
        residual_rms=(force_rms, torque_rms),
        samples=n,
    )


def _condition(rows: Array) -> float:
    """Condition number with every column scaled to length 1: what the choice of angles makes worse, not the units."""
    lengths = np.linalg.norm(rows, axis=0)
    return float(np.linalg.cond(rows / lengths)) if (lengths > 0).all() else np.inf


def _regress(rows: Array, values: Array) -> tuple[Array, Array, float]:
    solution = np.linalg.lstsq(rows, values, rcond=None)[0]
    residual = values - rows @ solution
    variance = float(residual @ residual) / (len(values) - rows.shape[1])
    solution = np.asarray(solution, np.float64)
    return solution, np.linalg.inv(rows.T @ rows) * variance, float(np.sqrt(np.mean(residual**2)))


@dataclass(frozen=True, eq=False)
class Agreement:
    """What two sensors say of one contact force: ``difference`` (2,) [N], wrist less table, axes of W.

    ``chi2`` has two degrees of freedom; ``probability`` is that of a larger one when only noise differs.
    """

    difference: Array
    chi2: float
    probability: float
    agrees: bool


def under_table_check(
    wrench_on_go: ArrayLike,
    weight: float,
    table_reading: ArrayLike,
    covariance: ArrayLike,
    table_angle: float = 0.0,
    significance: float = 0.01,
) -> Agreement:
    """Compare the force on the go's contact with the table as the wrist and as the under-table sensor have it.

    ``wrench_on_go`` (3,) of the sensor on the go, axes of W (`WristSensor.wrench_on_go`); ``weight`` [N] of everything
    between fingers and table; ``table_reading`` (6,), tared, in a frame at ``table_angle`` [rad] in W. The table's
    sensor reads what the load side does *to it* (`WrenchReading`): the go's push on the table, which at rest is the
    fingers' push plus the weight. ``covariance`` (2, 2) [N²] is that of the difference: noise of both means, and what
    both have drifted since their zeros. Raises FitError for NaN or a covariance that is not positive definite.
    """
    on_go = finite_rows("wrist wrench", np.asarray(wrench_on_go)[None], (3,))[0]
    reading = finite_rows("under-table reading", np.asarray(table_reading)[None], (6,))[0]
    cov = finite_rows("covariance of the difference", np.asarray(covariance)[None], (2, 2))[0]
    if np.linalg.eigvalsh(cov)[0] <= 0:
        raise FitError(
            "covariance of the difference", "positive definite", f"{cov.tolist()}", "Give both sensors a noise."
        )
    on_table = wrench.rotated(TaskPlane().wrench_to_planar(reading), table_angle)[:2]
    difference = on_go[:2] - (0.0, weight) - on_table
    value = float(difference @ np.linalg.solve(cov, difference))
    probability = float(chdtrc(2, value))
    return Agreement(difference, value, probability, probability >= significance)
