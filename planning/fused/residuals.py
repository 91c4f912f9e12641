"""The losses of a step and their derivatives, compiled; `planning.losses` says what they are and why.

``level`` is 0 for the loss alone, 1 with its gradient, 2 with the Gauss–Newton block as well. Derivatives are with the
variables of the step, times their scale, and 0 where a variable is not free. With level 2 each residual has its own.
With level 1 what comes by forces, slack, wrench and hand is summed by these, for `planning.fused.adjoint` to go on.
"""

from __future__ import annotations

from math import acos, atan2, ceil, cos, inf, log, log1p, pi, sin, sqrt

from planning.fused.layout import (
    ANGLE,
    BASE,
    BY_EE,
    BY_F,
    BY_WRENCH,
    BY_Z,
    C_AX,
    C_AY,
    C_TX,
    C_TY,
    C_X,
    C_Y,
    COMPLIANCE,
    D_Z,
    DEE,
    DF,
    DQ,
    DW,
    EE,
    ELBOW,
    F_N,
    F_T,
    F_X,
    F_Y,
    FORE,
    GO_WEIGHT,
    GRASP,
    HIGHEST,
    JOINT_HALF,
    JOINT_MIDDLE,
    JOINTS,
    LOWEST,
    MOST_F,
    MOST_FORCE,
    MOST_T,
    MOST_TORQUE,
    N_X,
    N_Y,
    OBJECTS,
    OPEN,
    PAPER,
    POSE,
    POSE_D,
    RAY,
    RES,
    RHO,
    ROOT_SLACK,
    SCALE,
    SENSED,
    STIFFNESS,
    TOOL,
    TRAVEL,
    TURNS,
    TWO_BODIES,
    UPPER,
    W_CONE,
    W_FORCE,
    W_JOINTS,
    W_PENETRATION,
    W_PULL,
    W_SENSOR,
    W_SLACK,
    W_TRACK,
    W_WORKSPACE,
    WISH,
    WORK_HALF,
    WORK_MIDDLE,
    WORKSPACE,
    WRENCH,
    ZERO,
    Y,
    Z,
)
from planning.fused.sources import inlined, kernel

MILLIMETRE = 1e-3
NO_FORCE = 1e-9
"""As in `planning.losses`."""


@kernel
def _add(w, gradient, hessian, k, r, level):
    """Enter a residual, with level 2 by its derivatives, in row RES; returns its square."""
    if level == 2:
        for j in range(5):
            d = 2 * w[RES, j]
            gradient[k, j] += r * d
            for m in range(5):
                hessian[k, j, m] += d * w[RES, m]
    return r * r


@kernel
def _add_alone(gradient, hessian, k, j, r, d, level):
    """Enter a residual that depends on variable j only; returns its square."""
    if level:
        gradient[k, j] += 2 * r * d
        if level == 2:
            hessian[k, j, j] += 2 * d * d
    return r * r


@kernel
def _barrier(squared):
    """−1/10 log(1 − u²), +inf outside, where u² is no number too."""
    return -0.1 * log1p(-squared) if squared < 1 else inf


@inlined
def of_step(w, c, kinds, free, steps, fixed, flags, gradient, hessian, k, level):
    """Return the step's loss without smoothness; add to ``gradient`` (5,) and ``hessian`` (5, 5)."""
    if level == 1:
        for r in range(4):
            w[BY_F, r], w[BY_Z, r], w[BY_WRENCH, r], w[BY_EE, r] = 0.0, 0.0, 0.0, 0.0
    total = _of_angle(w, free, steps, fixed, gradient, hessian, k, level)
    if total == inf:
        return inf
    total += _of_forces(w, c, kinds, steps, fixed, flags, gradient, hessian, k, level)
    if flags[PAPER] and fixed[W_SLACK] > 0:
        for r in range(3):
            factor = fixed[W_SLACK] / w[ROOT_SLACK, r] / (fixed[RHO] if r == 2 else 1.0)
            if level == 1:
                w[BY_Z, r] = 2 * w[Z, r] * factor * factor
            elif level == 2:
                for j in range(5):
                    w[RES, j] = w[D_Z + j, r] * factor if free[k, j] else 0.0
            total += _add(w, gradient, hessian, k, w[Z, r] * factor, level)
    where = flags[WORKSPACE] or flags[JOINTS]
    if where or flags[MOST_F] or flags[MOST_T]:
        _sensor_and_hand(w, c, free, fixed, flags, where, k, level)
        total += _of_hand(w, fixed, flags, gradient, hessian, k, level)
    return total


@inlined
def _of_angle(w, free, steps, fixed, gradient, hessian, k, level):
    """Penetration and tracking."""
    total = 0.0
    if fixed[W_PENETRATION] > 0:
        slope = fixed[SCALE] if free[k, 0] else 0.0
        for side in range(2):
            room = w[Y, 0] - steps[k, LOWEST] if side == 0 else steps[k, HIGHEST] - w[Y, 0]
            if not room > 0:
                return inf
            r = -0.1 * log(room) * fixed[W_PENETRATION]
            d = (0.1 if side else -0.1) / room * fixed[W_PENETRATION] * slope
            total += _add_alone(gradient, hessian, k, 0, r, d, level)
    if fixed[W_TRACK] > 0:
        for j in range(2):
            size = fixed[W_TRACK] * (fixed[RHO] if j == 0 else 1.0) / MILLIMETRE
            r = size * (w[Y, j] - steps[k, ANGLE if j == 0 else TRAVEL])
            total += _add_alone(gradient, hessian, k, j, r, size * fixed[SCALE + j] if free[k, j] else 0.0, level)
    return total


@inlined
def _of_forces(w, c, kinds, steps, fixed, flags, gradient, hessian, k, level):
    """Cone, pull and contact force."""
    total, n = 0.0, flags[OBJECTS]
    sum_n, sum_t = -steps[k, WISH], -steps[k, WISH + 1]
    for at in range(n):
        f_n, f_t, row = c[at, F_N], c[at, F_T], DF + 2 * at
        sum_n += f_n
        sum_t += f_t
        if kinds[k, at] == OPEN and fixed[W_CONE] > 0:
            size = sqrt(f_n * f_n + f_t * f_t + NO_FORCE * NO_FORCE)
            if level:
                cube = fixed[W_CONE] / (size * size * size)
                by_n, by_t = -(f_t * f_t + NO_FORCE * NO_FORCE) * cube, f_n * f_t * cube
                if level == 1:
                    d = 2 * fixed[W_CONE] * (1 - f_n / size)
                    w[BY_F, 2 * at] += d * by_n
                    w[BY_F, 2 * at + 1] += d * by_t
                else:
                    for j in range(5):
                        w[RES, j] = by_n * w[row, j] + by_t * w[row + 1, j]
            total += _add(w, gradient, hessian, k, fixed[W_CONE] * (1 - f_n / size), level)
        if f_n < 0 and kinds[k, at] in (OPEN, RAY) and fixed[W_PULL] > 0:
            if level == 1:
                w[BY_F, 2 * at] += 2 * fixed[W_PULL] * fixed[W_PULL] * f_n
            elif level == 2:
                for j in range(5):
                    w[RES, j] = fixed[W_PULL] * w[row, j]
            total += _add(w, gradient, hessian, k, fixed[W_PULL] * f_n, level)
    if fixed[W_FORCE] > 0:
        for side in range(2):
            if level == 1:
                d = 2 * fixed[W_FORCE] * fixed[W_FORCE] * (sum_n if side == 0 else sum_t)
                for at in range(n):
                    w[BY_F, 2 * at + side] += d
            elif level == 2:
                for j in range(5):
                    d = w[DF + side, j]
                    if n == 2:
                        d += w[DF + 2 + side, j]
                    w[RES, j] = fixed[W_FORCE] * d
            total += _add(w, gradient, hessian, k, fixed[W_FORCE] * (sum_n if side == 0 else sum_t), level)
    return total


@kernel
def _sensor_and_hand(w, c, free, fixed, flags, where, k, level):
    """Write the sensor's wrench and X_W_ee, and their derivatives."""
    sign = -1.0 if flags[TWO_BODIES] else 1.0
    paper, gx, gy = flags[PAPER], w[POSE, 3], w[POSE, 4]
    co, si = w[POSE, 5], w[POSE, 6]
    if not paper:
        wx, wy, wt = 0.0, fixed[GO_WEIGHT], -(gx - w[POSE, 0]) * fixed[GO_WEIGHT]
        for at in range(flags[OBJECTS]):
            wx -= sign * c[at, F_X]
            wy -= sign * c[at, F_Y]
            wt -= sign * ((c[at, C_X] - gx) * c[at, F_Y] - (c[at, C_Y] - gy) * c[at, F_X])
        w[WRENCH, 0], w[WRENCH, 1], w[WRENCH, 2] = wx, wy, wt
        w[SENSED, 0], w[SENSED, 1], w[SENSED, 2] = co * wx + si * wy, co * wy - si * wx, wt
    px, py, turn = w[Y, 2], w[Y, 3], w[Y, 4]
    if not paper:
        px, py, turn = _comply(fixed, w[SENSED, 0], w[SENSED, 1], w[SENSED, 2])
    w[EE, 0], w[EE, 1] = gx + co * px - si * py, gy + si * px + co * py
    w[EE, 2] = w[POSE, 2] + fixed[GRASP + 2] + turn
    if level < 2:
        return
    for j in range(5):
        if not free[k, j]:
            for r in range(3):
                w[DW + r, j] = 0.0
                w[DEE + r, j] = 0.0
            continue
        scale = fixed[SCALE + j]
        _wrench_varies(w, c, fixed, flags, sign, j, scale)
        if not where:
            continue
        a = scale if j == 0 else 0.0
        if paper:
            x, y = (scale if j == 2 else 0.0), (scale if j == 3 else 0.0)
            t = scale if j == 4 else 0.0
        else:
            x = co * w[DW, j] + si * w[DW + 1, j] + a * w[SENSED, 1]
            y = co * w[DW + 1, j] - si * w[DW, j] - a * w[SENSED, 0]
            x, y, t = _comply(fixed, x, y, w[DW + 2, j])
        dgx, dgy = 0.0, 0.0
        if j == 0:
            dgx, dgy = w[POSE_D, 4] * scale, w[POSE_D, 5] * scale
        elif j == 1:
            dgx, dgy = w[POSE_D, 2] * scale, w[POSE_D, 3] * scale
        w[DEE, j] = dgx + co * x - si * y - a * (si * px + co * py)
        w[DEE + 1, j] = dgy + si * x + co * y + a * (co * px - si * py)
        w[DEE + 2, j] = a + t


@kernel
def _comply(fixed, x, y, t):
    """K⁻¹ w."""
    a = COMPLIANCE
    return (
        fixed[a] * x + fixed[a + 1] * y + fixed[a + 2] * t,
        fixed[a + 3] * x + fixed[a + 4] * y + fixed[a + 5] * t,
        fixed[a + 6] * x + fixed[a + 7] * y + fixed[a + 8] * t,
    )


@kernel
def _wrench_varies(w, c, fixed, flags, sign, j, scale):
    """Derivative of the sensor's wrench with variable j."""
    gx, gy = w[POSE, 3], w[POSE, 4]
    a = scale if j == 0 else 0.0
    if flags[PAPER]:
        x, y, t = -a * w[WRENCH, 1], a * w[WRENCH, 0], 0.0
        if j >= 2:
            kx, ky = fixed[STIFFNESS + j - 2] * scale, fixed[STIFFNESS + 3 + j - 2] * scale
            x, y = w[POSE, 5] * kx - w[POSE, 6] * ky, w[POSE, 6] * kx + w[POSE, 5] * ky
            t = fixed[STIFFNESS + 6 + j - 2] * scale
        w[DW, j], w[DW + 1, j], w[DW + 2, j] = x, y, t
        return
    dgx, dgy = 0.0, 0.0
    if j == 0:
        dgx, dgy = w[POSE_D, 4] * scale, w[POSE_D, 5] * scale
    elif j == 1:
        dgx, dgy = w[POSE_D, 2] * scale, w[POSE_D, 3] * scale
    x, y, t = 0.0, 0.0, a * (gy - w[POSE, 1]) * fixed[GO_WEIGHT]
    for at in range(flags[OBJECTS]):
        nx, ny, turns = c[at, N_X], c[at, N_Y], a * c[at, TURNS]
        d_n, d_t = w[DF + 2 * at, j], w[DF + 2 * at + 1, j]
        fx, fy = c[at, F_X], c[at, F_Y]
        dfx, dfy = d_n * nx + d_t * ny - turns * fy, d_n * ny - d_t * nx + turns * fx
        bx, by = -dgx, -dgy
        if j == 0:
            bx, by = bx + c[at, C_AX] * scale, by + c[at, C_AY] * scale
        elif j == 1:
            bx, by = bx + c[at, C_TX] * scale, by + c[at, C_TY] * scale
        x -= sign * dfx
        y -= sign * dfy
        t -= sign * ((c[at, C_X] - gx) * dfy - (c[at, C_Y] - gy) * dfx + bx * fy - by * fx)
    w[DW, j], w[DW + 1, j], w[DW + 2, j] = x, y, t


@kernel
def _of_hand(w, fixed, flags, gradient, hessian, k, level):
    """Workspace, joints and sensor."""
    total = 0.0
    if flags[WORKSPACE]:
        for r in range(3):
            half = fixed[WORK_HALF + r]
            u = (w[EE, r] - fixed[WORK_MIDDLE + r]) / half
            if level and u * u < 1:
                slope = fixed[W_WORKSPACE] * 0.2 * u / (1 - u * u) / half
                if level == 1:
                    w[BY_EE, r] += 2 * fixed[W_WORKSPACE] * _barrier(u * u) * slope
                else:
                    for j in range(5):
                        w[RES, j] = slope * w[DEE + r, j]
            total += _add(w, gradient, hessian, k, fixed[W_WORKSPACE] * _barrier(u * u), level)
    if flags[JOINTS]:
        if not _bend(w, fixed, level):
            return inf
        for r in range(3):
            u = w[DQ + r, 3]
            if level and u * u < 1:
                slope = fixed[W_JOINTS] * 0.2 * u / (1 - u * u) / fixed[JOINT_HALF + r]
                if level == 1:
                    d = 2 * fixed[W_JOINTS] * _barrier(u * u) * slope
                    for j in range(3):
                        w[BY_EE, j] += d * w[DQ + r, j]
                else:
                    for j in range(5):
                        d = w[DQ + r, 0] * w[DEE, j] + w[DQ + r, 1] * w[DEE + 1, j] + w[DQ + r, 2] * w[DEE + 2, j]
                        w[RES, j] = slope * d
            total += _add(w, gradient, hessian, k, fixed[W_JOINTS] * _barrier(u * u), level)
    if flags[MOST_F]:
        most = fixed[MOST_FORCE]
        wx, wy = w[WRENCH, 0] / most, w[WRENCH, 1] / most
        squared = wx * wx + wy * wy
        if level and squared < 1:
            slope = fixed[W_SENSOR] * 0.2 / (1 - squared) / most
            if level == 1:
                d = 2 * fixed[W_SENSOR] * _barrier(squared) * slope
                w[BY_WRENCH, 0] += d * wx
                w[BY_WRENCH, 1] += d * wy
            else:
                for j in range(5):
                    w[RES, j] = slope * (wx * w[DW, j] + wy * w[DW + 1, j])
        total += _add(w, gradient, hessian, k, fixed[W_SENSOR] * _barrier(squared), level)
    if flags[MOST_T]:
        u = w[WRENCH, 2] / fixed[MOST_TORQUE]
        if level and u * u < 1:
            slope = fixed[W_SENSOR] * 0.2 * u / (1 - u * u) / fixed[MOST_TORQUE]
            if level == 1:
                w[BY_WRENCH, 2] += 2 * fixed[W_SENSOR] * _barrier(u * u) * slope
            else:
                for j in range(5):
                    w[RES, j] = slope * w[DW + 2, j]
        total += _add(w, gradient, hessian, k, fixed[W_SENSOR] * _barrier(u * u), level)
    return total


@kernel
def _bend(w, fixed, level):
    """Write the joints for X_W_ee, from −1 to 1 between their limits, and ∂q/∂(x, y, θ); False out of reach."""
    a, b = fixed[UPPER], fixed[FORE]
    co, si = cos(w[EE, 2]), sin(w[EE, 2])
    tx, ty = co * fixed[TOOL] - si * fixed[TOOL + 1], si * fixed[TOOL] + co * fixed[TOOL + 1]
    rx, ry = w[EE, 0] - tx - fixed[BASE], w[EE, 1] - ty - fixed[BASE + 1]
    square = rx * rx + ry * ry
    cosine = (square - a * a - b * b) / (2 * a * b)
    if not abs(cosine) < 1:
        return False
    elbow = fixed[ELBOW] * acos(cosine)
    sine = fixed[ELBOW] * sqrt(1 - cosine * cosine)
    shoulder = atan2(ry, rx) - atan2(b * sine, a + b * cosine)
    for r in range(3):
        q = shoulder if r == 0 else (elbow if r == 1 else w[EE, 2] - shoulder - elbow)
        q += fixed[ZERO + r] - fixed[JOINT_MIDDLE + r]
        w[DQ + r, 3] = (q - 2 * pi * ceil((q - pi) / (2 * pi))) / fixed[JOINT_HALF + r]
    if level:
        for j in range(3):
            # the wrist's motion as ee moves along x, along y, as it turns
            x, y = (1.0 if j == 0 else ty if j == 2 else 0.0), (1.0 if j == 1 else -tx if j == 2 else 0.0)
            d_elbow = -(rx * x + ry * y) / (a * b * sine)
            d_shoulder = (rx * y - ry * x) / square - (b * b + a * b * cosine) / square * d_elbow
            w[DQ, j], w[DQ + 1, j] = d_shoulder, d_elbow
            w[DQ + 2, j] = (1.0 if j == 2 else 0.0) - d_shoulder - d_elbow
    return True
