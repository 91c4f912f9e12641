"""The ways to solve contact programs, by name."""

from __future__ import annotations

from collections.abc import Callable

from planning.program import Backend


def _cvxpylayers() -> Backend:
    from planning.qp_reference import solve_accurate

    return solve_accurate


def _cvxpylayers_fast() -> Backend:
    from planning.qp_reference import solve_fast

    return solve_fast


def _torch() -> Backend:
    from planning.qp_torch import solve

    return solve


def _fused() -> Backend:
    from planning.qp_fused import solve

    return solve


BACKENDS: dict[str, Callable[[], Backend]] = {
    "cvxpylayers": _cvxpylayers,
    "cvxpylayers-fast": _cvxpylayers_fast,
    "torch": _torch,
    "fused": _fused,
}
"""Every backend by name, each imported only when it is asked for."""
