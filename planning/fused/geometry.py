"""From a step's variables to its contact program, and how its data change with them, compiled.

The closure is that of `planning.closure`. With J the turn by +90°, a normal that turns with the go has ∂n/∂angle = J n,
and a force F in W at lever a changes its wrench, at fixed (f_n, f_t), by (∂F, ∂a × F + a × ∂F) with ∂F = J F.
"""

from __future__ import annotations

from math import cos, sin

from planning.fused.layout import (
    ABSENT,
    C_AX,
    C_AY,
    C_TX,
    C_TY,
    C_X,
    C_Y,
    CONTACT_OF,
    CORNERS,
    D_E,
    D_G,
    D_N,
    D_RHS,
    D_T,
    D_TARGET,
    D_Z,
    DF,
    EO,
    EO_WEIGHT,
    EO_X,
    EO_Y,
    EQUAL_RANK,
    F_N,
    F_T,
    F_X,
    F_Y,
    FACE_GO,
    GO,
    GO_WEIGHT,
    GRASP,
    GRASP_TURN,
    GROUND,
    GROUNDS,
    LENGTH,
    LOAD_EO,
    LOAD_GO,
    MU,
    N_X,
    N_Y,
    NU,
    OBJECT,
    OBJECTS,
    OMEGA,
    P_GO,
    PAPER,
    POSE,
    POSE_D,
    RANK,
    ROOT_SLACK,
    ROW_OF,
    SENSED,
    SLOPE,
    STIFFNESS,
    T_N,
    T_T,
    THETA_EO,
    TURNS,
    TWO_BODIES,
    U_N,
    U_OBJECT,
    U_T,
    UNKNOWNS,
    WRENCH,
    Y,
)
from planning.fused.program import respond
from planning.fused.sources import inlined, kernel


@inlined
def place(w, c, kinds, steps, fixed, flags, k):
    """Write the poses, the contacts and the loads at the variables in row Y."""
    angle, travel = w[Y, 0], w[Y, 1]
    theta = steps[k, THETA_EO] + angle
    co, si = cos(theta), sin(theta)
    n = flags[OBJECTS]
    for at in range(n):
        corner = flags[CORNERS] >> at & 1
        base = OBJECT + 6 * at
        px, py = fixed[P_GO + 2 * at], fixed[P_GO + 2 * at + 1]
        nx, ny = steps[k, base + 4], steps[k, base + 5]
        if corner:
            c[at, N_X], c[at, N_Y], c[at, TURNS] = nx, ny, 0.0
        else:
            c[at, N_X], c[at, N_Y], c[at, TURNS] = co * nx - si * ny, si * nx + co * ny, 1.0
            if at == 0:
                px += travel * fixed[FACE_GO]
                py += travel * fixed[FACE_GO + 1]
        rx, ry = co * px - si * py, si * px + co * py
        c[at, C_X], c[at, C_Y] = steps[k, base], steps[k, base + 1]
        c[at, C_AX], c[at, C_AY], c[at, C_TX], c[at, C_TY] = 0.0, 0.0, 0.0, 0.0
        if at == 0:
            if corner:
                ex, ey = steps[k, base + 2], steps[k, base + 3]
                c[at, C_X] += travel * ex
                c[at, C_Y] += travel * ey
                c[at, C_TX], c[at, C_TY] = ex, ey
            else:
                ex = si * fixed[FACE_GO + 1] - co * fixed[FACE_GO]
                ey = -si * fixed[FACE_GO] - co * fixed[FACE_GO + 1]
            w[POSE, 0], w[POSE, 1], w[POSE, 2] = c[at, C_X] - rx, c[at, C_Y] - ry, theta
            w[POSE_D, 0], w[POSE_D, 1], w[POSE_D, 2], w[POSE_D, 3] = ry, -rx, ex, ey
        elif corner:
            c[at, C_X], c[at, C_Y] = w[POSE, 0] + rx, w[POSE, 1] + ry
            c[at, C_AX], c[at, C_AY] = w[POSE_D, 0] - ry, w[POSE_D, 1] + rx
            c[at, C_TX], c[at, C_TY] = w[POSE_D, 2], w[POSE_D, 3]
    gx = co * fixed[GRASP] - si * fixed[GRASP + 1]
    gy = si * fixed[GRASP] + co * fixed[GRASP + 1]
    w[POSE, 3], w[POSE, 4] = w[POSE, 0] + gx, w[POSE, 1] + gy
    w[POSE_D, 4], w[POSE_D, 5] = w[POSE_D, 0] - gy, w[POSE_D, 1] + gx
    w[POSE, 5] = co * fixed[GRASP_TURN] - si * fixed[GRASP_TURN + 1]
    w[POSE, 6] = si * fixed[GRASP_TURN] + co * fixed[GRASP_TURN + 1]

    paper, two = flags[PAPER], flags[TWO_BODIES]
    touching = 0
    for at in range(n):
        touching += kinds[k, at] != ABSENT
    share = 0.0 if paper or touching == 0 else 1.0 / touching
    weight = 1.0 if paper else fixed[U_OBJECT]
    for at in range(n):
        c[at, MU], c[at, U_N], c[at, U_T] = steps[k, SLOPE + at], weight, weight
        c[at, D_N], c[at, D_T] = share * w[Y, 2], share * w[Y, 3]
        if two:
            _lever(c, at, EO, c[at, C_X] - steps[k, EO_X], c[at, C_Y] - steps[k, EO_Y], 1.0)
        if paper:
            _lever(c, at, GO, c[at, C_X] - w[POSE, 3], c[at, C_Y] - w[POSE, 4], -1.0 if two else 1.0)
    for m in range(flags[GROUNDS]):
        at = n + m
        c[at, MU], c[at, U_N], c[at, U_T] = steps[k, SLOPE + at], 1.0, 1.0
        c[at, D_N], c[at, D_T] = 0.0, 0.0
        c[at, N_X], c[at, N_Y] = 0.0, 1.0
        _lever(c, at, EO, steps[k, GROUND + 2 * m], steps[k, GROUND + 2 * m + 1], 1.0)
        for r in range(6):
            c[at, GO + r] = 0.0
    w[LOAD_EO, 0], w[LOAD_EO, 1], w[LOAD_EO, 2] = 0.0, -fixed[EO_WEIGHT], 0.0
    if paper:
        for r in range(3):
            total = 0.0
            for j in range(3):
                total += fixed[STIFFNESS + 3 * r + j] * w[Y, 2 + j]
            w[SENSED, r] = total
        w[WRENCH, 0] = w[POSE, 5] * w[SENSED, 0] - w[POSE, 6] * w[SENSED, 1]
        w[WRENCH, 1] = w[POSE, 6] * w[SENSED, 0] + w[POSE, 5] * w[SENSED, 1]
        w[WRENCH, 2] = w[SENSED, 2]
        w[LOAD_GO, 0] = w[WRENCH, 0]
        w[LOAD_GO, 1] = w[WRENCH, 1] - fixed[GO_WEIGHT]
        w[LOAD_GO, 2] = w[WRENCH, 2] + gx * fixed[GO_WEIGHT]  # the weight acts at −(gx, gy) from the grasp centre


@inlined
def _lever(c, at, rows, ax, ay, sign):
    """Write a contact's Jacobian on a body to whose origin the lever is (ax, ay)."""
    nx, ny = sign * c[at, N_X], sign * c[at, N_Y]
    c[at, rows], c[at, rows + 1], c[at, rows + 2] = nx, ny, ax * ny - ay * nx
    c[at, rows + 3], c[at, rows + 4], c[at, rows + 5] = ny, -nx, -ax * nx - ay * ny


@inlined
def forces_in_world(c, contacts):
    """Write the forces found in the axes of W."""
    for at in range(contacts):
        nx, ny = c[at, N_X], c[at, N_Y]
        c[at, F_X] = c[at, F_N] * nx + c[at, F_T] * ny
        c[at, F_Y] = c[at, F_N] * ny - c[at, F_T] * nx


@kernel
def differentiate(w, c, i, kinds, free, steps, fixed, flags, k):
    """Write the derivatives of the object contacts' forces with the free variables, times their scale, to rows DF.

    The model of second order needs each of them; the gradient alone does without (`planning.fused.adjoint`).
    The implicit function theorem on the active rows: with the data's derivatives δ, the forces' solve the program
    with target U δf_des + δJ_eo ν − δJ_go ω, right sides −δJ_eoᵀ f and slack √W (δgo_load + δJ_goᵀ f).
    """
    unknowns, rank = i[UNKNOWNS], i[RANK]
    paper, n = flags[PAPER], flags[OBJECTS]
    for r in range(2 * n):
        for j in range(5):
            w[DF + r, j] = 0.0
    for j in range(5):
        if not free[k, j]:
            continue
        scale = fixed[j]
        for m in range(8):
            w[D_TARGET + j, m] = 0.0
            w[D_RHS + j, m] = 0.0
        w[D_E + j, 0], w[D_E + j, 1], w[D_E + j, 2] = 0.0, 0.0, 0.0
        if j < 2:
            _geometry_varies(w, c, i, kinds, j, scale, steps, fixed, flags, k)
        elif paper:
            kx, ky = fixed[STIFFNESS + j - 2] * scale, fixed[STIFFNESS + 3 + j - 2] * scale
            w[D_E + j, 0] = w[POSE, 5] * kx - w[POSE, 6] * ky
            w[D_E + j, 1] = w[POSE, 6] * kx + w[POSE, 5] * ky
            w[D_E + j, 2] = fixed[STIFFNESS + 6 + j - 2] * scale
        elif j < 4:
            touching = 0
            for at in range(n):
                touching += kinds[k, at] != ABSENT
            for m in range(unknowns):
                if i[CONTACT_OF + m] < n:
                    of = w[T_N, m] if j == 2 else w[T_T, m]
                    w[D_TARGET + j, m] = of * c[i[CONTACT_OF + m], U_N] * scale / touching
        if paper:
            for r in range(3):
                w[D_E + j, r] *= w[ROOT_SLACK, r]
        respond(w, unknowns, rank, paper, D_TARGET + j, D_RHS + j, D_E + j, D_G + j, D_Z + j)
        for m in range(unknowns):
            at = i[CONTACT_OF + m]
            if at < n:
                w[DF + 2 * at, j] += w[T_N, m] * w[D_G + j, m]
                w[DF + 2 * at + 1, j] += w[T_T, m] * w[D_G + j, m]


@kernel
def _geometry_varies(w, c, i, kinds, j, scale, steps, fixed, flags, k):
    """Target, right sides and slack as the angle (j = 0) or travel (j = 1) varies; the slack not yet weighted."""
    unknowns, n = i[UNKNOWNS], flags[OBJECTS]
    turn = scale if j == 0 else 0.0
    gx, gy = (w[POSE_D, 4], w[POSE_D, 5]) if j == 0 else (w[POSE_D, 2], w[POSE_D, 3])
    gx, gy = gx * scale, gy * scale
    lacks_x, lacks_y, lacks_t = 0.0, 0.0, 0.0
    for at in range(n):
        if kinds[k, at] == ABSENT:
            continue
        cx = (c[at, C_AX] if j == 0 else c[at, C_TX]) * scale
        cy = (c[at, C_AY] if j == 0 else c[at, C_TY]) * scale
        turns = turn * c[at, TURNS]
        nx, ny, fx, fy = c[at, N_X], c[at, N_Y], c[at, F_X], c[at, F_Y]
        dfx, dfy = -turns * fy, turns * fx
        on_n, on_t = 0.0, 0.0
        if flags[TWO_BODIES]:
            ax, ay = c[at, C_X] - steps[k, EO_X], c[at, C_Y] - steps[k, EO_Y]
            lacks_x += dfx
            lacks_y += dfy
            lacks_t += cx * fy - cy * fx + ax * dfy - ay * dfx
            d_n, d_t = _pairing(nx, ny, turns, ax, ay, cx, cy, w[NU, 0], w[NU, 1], w[NU, 2])
            on_n, on_t = d_n, d_t
        if flags[PAPER]:
            sign = -1.0 if flags[TWO_BODIES] else 1.0
            ax, ay = c[at, C_X] - w[POSE, 3], c[at, C_Y] - w[POSE, 4]
            bx, by = cx - gx, cy - gy
            w[D_E + j, 0] += sign * dfx
            w[D_E + j, 1] += sign * dfy
            w[D_E + j, 2] += sign * (bx * fy - by * fx + ax * dfy - ay * dfx)
            d_n, d_t = _pairing(nx, ny, turns, ax, ay, bx, by, w[OMEGA, 0], w[OMEGA, 1], w[OMEGA, 2])
            on_n -= sign * d_n
            on_t -= sign * d_t
        for m in range(unknowns):
            if i[CONTACT_OF + m] == at:
                w[D_TARGET + j, m] = w[T_N, m] * on_n + w[T_T, m] * on_t
    for m in range(i[EQUAL_RANK]):
        r = i[ROW_OF + m]
        w[D_RHS + j, m] = -lacks_x if r == 0 else (-lacks_y if r == 1 else -lacks_t / fixed[LENGTH])
    if flags[PAPER] and j == 0:
        w[D_E + j, 0] -= w[WRENCH, 1] * scale
        w[D_E + j, 1] += w[WRENCH, 0] * scale
        w[D_E + j, 2] -= (w[POSE, 4] - w[POSE, 1]) * fixed[GO_WEIGHT] * scale


@kernel
def _pairing(nx, ny, turns, ax, ay, bx, by, vx, vy, omega):
    """Change of the velocities along n and t of a point under the twist (vx, vy, ω), as its lever a changes by b."""
    ux, uy = vx - omega * ay, vy + omega * ax
    dux, duy = -omega * by, omega * bx
    d_n = turns * (-ny * ux + nx * uy) + nx * dux + ny * duy
    d_t = turns * (nx * ux + ny * uy) + ny * dux - nx * duy
    return d_n, d_t
