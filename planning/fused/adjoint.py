"""The gradient of a step's loss by one backward solve of its program, compiled.

The losses leave their derivatives by what they are made of in the rows ``BY_``: the object contacts' forces, the
weighted slack, the sensor's wrench and the end-effector. With p that by the unknowns g and q that by the slack z, the
program answers for its data, active rows being what they are, as (the transpose of `planning.fused.program.respond`)

    (1 + M Mᵀ) z̄ = q − M p,   target: a = (1 − QᵀQ)(p + Bᵀ z̄),   right sides: R y = Q (p + Bᵀ z̄),   slack: z̄

A contact enters the data through J alone, and Jᵀf with a twist (v, ω) pairs to F · (v + ω × lever): what the loss owes
to its point and to the turn of its normal are sums of such pairs, with no derivative of J written down.
"""

from __future__ import annotations

from planning.fused.layout import (
    ABSENT,
    BACK,
    BASE_BACK,
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
    CONTACT_OF,
    EE,
    EO_X,
    EO_Y,
    EQUAL_RANK,
    F_X,
    F_Y,
    GO_WEIGHT,
    JOINTS,
    LENGTH,
    N_X,
    N_Y,
    NU,
    NU_BACK,
    OBJECTS,
    OMEGA,
    PAPER,
    POSE,
    POSE_D,
    RANK,
    ROOT_SLACK,
    ROW_OF,
    SCALE,
    SENSED,
    STIFFNESS,
    T_N,
    T_T,
    TURNS,
    TWO_BODIES,
    U_OBJECT,
    UNKNOWNS,
    WORKSPACE,
    WRENCH,
    Z_BACK,
    B,
    L,
    M,
    Q,
    R,
)
from planning.fused.sources import inlined, kernel


@inlined
def pull_back(w, c, i, kinds, free, steps, fixed, flags, gradient, k):
    """Add to ``gradient`` (5,) what the loss owes to the variables through all but the angle and travel themselves."""
    n, paper, two = flags[OBJECTS], flags[PAPER], flags[TWO_BODIES]
    sign = -1.0 if two else 1.0
    gx, gy, co, si = w[POSE, 3], w[POSE, 4], w[POSE, 5], w[POSE, 6]
    by_angle, by_x, by_y, v0, v1, v2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0  # x, y: of the grasp centre
    if flags[WORKSPACE] or flags[JOINTS]:
        by_x, by_y, t = w[BY_EE, 0], w[BY_EE, 1], w[BY_EE, 2]
        by_angle = t + by_y * (w[EE, 0] - gx) - by_x * (w[EE, 1] - gy)
        v0, v1, v2 = co * by_x + si * by_y, co * by_y - si * by_x, t
        if not paper:
            s0, s1, s2 = _transposed(fixed, COMPLIANCE, v0, v1, v2)
            by_angle += s0 * w[SENSED, 1] - s1 * w[SENSED, 0]
            w[BY_WRENCH, 0] += co * s0 - si * s1
            w[BY_WRENCH, 1] += si * s0 + co * s1
            w[BY_WRENCH, 2] += s2
    ox, oy, ot = 0.0, 0.0, 0.0  # by the go's balance, a twist; in the closed form it gives the sensor's wrench
    if not paper:
        ox, oy, ot = -w[BY_WRENCH, 0], -w[BY_WRENCH, 1], -w[BY_WRENCH, 2]
        for at in range(n):
            ux, uy = ox - ot * (c[at, C_Y] - gy), oy + ot * (c[at, C_X] - gx)
            w[BY_F, 2 * at] += sign * (ux * c[at, N_X] + uy * c[at, N_Y])
            w[BY_F, 2 * at + 1] += sign * (ux * c[at, N_Y] - uy * c[at, N_X])
    _respond_back(w, i, n, paper, two)
    if paper:
        ox, oy, ot = w[ROOT_SLACK, 0] * w[Z_BACK, 0], w[ROOT_SLACK, 1] * w[Z_BACK, 1], w[ROOT_SLACK, 2] * w[Z_BACK, 2]
    nx, ny, nt = 0.0, 0.0, 0.0
    if two:
        for r in range(3):
            w[NU_BACK, r] = 0.0
        for m in range(i[EQUAL_RANK]):
            w[NU_BACK, i[ROW_OF + m]] = w[BASE_BACK, m]
        nx, ny, nt = w[NU_BACK, 0], w[NU_BACK, 1], w[NU_BACK, 2] / fixed[LENGTH]

    by_travel, sum_n, sum_t, touching = 0.0, 0.0, 0.0, 0
    for at in range(n):
        if kinds[k, at] == ABSENT:
            continue
        touching += 1
        a_n, a_t = 0.0, 0.0
        for m in range(i[UNKNOWNS]):
            if i[CONTACT_OF + m] == at:
                a_n += w[T_N, m] * w[BACK, m]
                a_t += w[T_T, m] * w[BACK, m]
        sum_n += a_n
        sum_t += a_t
        fx, fy = c[at, F_X], c[at, F_Y]
        ax, ay = a_n * c[at, N_X] + a_t * c[at, N_Y], a_n * c[at, N_Y] - a_t * c[at, N_X]
        turns, px, py = 0.0, 0.0, 0.0  # by the turn of the normal, by the point
        if two:
            lx, ly = c[at, C_X] - steps[k, EO_X], c[at, C_Y] - steps[k, EO_Y]
            omega = w[NU, 2]
            ux, uy = w[NU, 0] - omega * ly, w[NU, 1] + omega * lx
            vx, vy = nx - nt * ly, ny + nt * lx
            turns += ax * uy - ay * ux - fx * vy + fy * vx
            px += omega * ay - nt * fy
            py -= omega * ax - nt * fx
        lx, ly = c[at, C_X] - gx, c[at, C_Y] - gy
        vx, vy = ox - ot * ly, oy + ot * lx
        g_turns, dx, dy = fx * vy - fy * vx, ot * fy, -ot * fx
        if paper:
            omega = w[OMEGA, 2]
            ux, uy = w[OMEGA, 0] - omega * ly, w[OMEGA, 1] + omega * lx
            g_turns -= ax * uy - ay * ux
            dx -= omega * ay
            dy += omega * ax
        dx, dy = sign * dx, sign * dy
        by_x -= dx
        by_y -= dy
        px, py, turns = px + dx, py + dy, turns + sign * g_turns
        by_angle += c[at, TURNS] * turns + px * c[at, C_AX] + py * c[at, C_AY]
        by_travel += px * c[at, C_TX] + py * c[at, C_TY]
    by_angle -= ot * (gy - w[POSE, 1]) * fixed[GO_WEIGHT]
    by_angle += by_x * w[POSE_D, 4] + by_y * w[POSE_D, 5]
    by_travel += by_x * w[POSE_D, 2] + by_y * w[POSE_D, 3]
    if paper:
        ox, oy, ot = ox + w[BY_WRENCH, 0], oy + w[BY_WRENCH, 1], ot + w[BY_WRENCH, 2]
        by_angle += oy * w[WRENCH, 0] - ox * w[WRENCH, 1]
        s0, s1, s2 = _transposed(fixed, STIFFNESS, co * ox + si * oy, co * oy - si * ox, ot)
        v0, v1, v2 = v0 + s0, v1 + s1, v2 + s2
    else:
        share = fixed[U_OBJECT] / max(touching, 1)
        v0, v1, v2 = share * sum_n, share * sum_t, 0.0
    if free[k, 0]:
        gradient[k, 0] += fixed[SCALE] * by_angle
    if free[k, 1]:
        gradient[k, 1] += fixed[SCALE + 1] * by_travel
    if free[k, 2]:
        gradient[k, 2] += fixed[SCALE + 2] * v0
    if free[k, 3]:
        gradient[k, 3] += fixed[SCALE + 3] * v1
    if free[k, 4]:
        gradient[k, 4] += fixed[SCALE + 4] * v2


@kernel
def _transposed(fixed, a, x, y, t):
    """Aᵀ (x, y, t) with the nine entries of A from ``a`` on."""
    return (
        fixed[a] * x + fixed[a + 3] * y + fixed[a + 6] * t,
        fixed[a + 1] * x + fixed[a + 4] * y + fixed[a + 7] * t,
        fixed[a + 2] * x + fixed[a + 5] * y + fixed[a + 8] * t,
    )


@inlined
def _respond_back(w, i, objects, paper, two):
    """Write the derivatives by the target (BACK), the right sides (BASE_BACK) and the weighted slack (Z_BACK)."""
    n, rank = i[UNKNOWNS], i[RANK]
    for j in range(n):
        at = i[CONTACT_OF + j]
        w[BACK, j] = w[T_N, j] * w[BY_F, 2 * at] + w[T_T, j] * w[BY_F, 2 * at + 1] if at < objects else 0.0
    for m in range(rank):
        d = 0.0
        for j in range(n):
            d += w[Q + m, j] * w[BACK, j]
        w[BASE_BACK, m] = d
        for j in range(n):
            w[BACK, j] -= d * w[Q + m, j]
    if paper:
        for r in range(3):
            total = w[BY_Z, r]
            for j in range(n):
                total -= w[B + r, j] * w[BACK, j]
            w[Z_BACK, r] = total
        x, y, t = w[Z_BACK, 0], w[Z_BACK, 1], w[Z_BACK, 2]
        for r in range(3):
            d = w[L + r, 0] * x + w[L + r, 1] * y + w[L + r, 2] * t
            w[Z_BACK, r] = d
            for j in range(n):
                w[BACK, j] += w[M + r, j] * d
        for r in range(2, -1, -1):
            for s in range(r + 1, 3):
                w[Z_BACK, r] -= w[L + r, 3 + s] * w[Z_BACK, s]
            w[Z_BACK, r] /= w[L + r, 3 + r]
        if two:
            x, y, t = w[Z_BACK, 0], w[Z_BACK, 1], w[Z_BACK, 2]
            for j in range(n):
                d = w[B, j] * x + w[B + 1, j] * y + w[B + 2, j] * t
                for m in range(rank):
                    w[BASE_BACK, m] += w[Q + m, j] * d
    if two:
        for m in range(rank - 1, -1, -1):
            d = w[BASE_BACK, m]
            for after in range(m + 1, rank):
                d -= w[R + m, after] * w[BASE_BACK, after]
            w[BASE_BACK, m] = d / w[R + m, m]
