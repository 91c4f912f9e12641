"""The membrane of a Soft Bubble that is pressed on the face of a polygon.

An inflated dome of height h₀ is pushed in by d: h = h₀ − d. Where nothing touches it, ∇²d = κ∫d dA: the gas it encloses
is compressed and pushes back everywhere, so the membrane bulges outward beside a contact and wraps past an edge of the
face. On the face it cannot pass, d ≥ h₀ − h_face, and on the rim d = 0. This is the minimum of
½∫|∇d|² + ½κ(∫d)² under that bound.

It is solved on a grid that is fixed to the dome, by projected multigrid (full approximation; Brandt and Cryer 1983,
SIAM J. Sci. Stat. Comput. 4), each frame from the last one. The rim and the face's edges need not lie on grid lines:
where they cross the arm between two nodes, the arm ends there (Shortley–Weller), so an edge lies where it is, to second
order in the spacing, whatever its direction.
"""

from __future__ import annotations

from math import ceil

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.sim import bubble_kernels as kernels
from drivers.sim.bubble_geometry import DOME, Dome
from mechanics.readings import Array

_LEVELS = 4
_MOST = 30  # cycles
_WHOLE = 6  # cycles with the whole correction
_ROOM = 4  # irregular nodes along the outline, over the number of nodes around the grid


class _Level:
    """One grid: nodes at multiples of ``spacing`` from the dome's axis, and what lies between them."""

    def __init__(self, dome: Dome, spacing: float, half_rows: int, half_columns: int):
        self.spacing, self.shape = spacing, (2 * half_rows + 1, 2 * half_columns + 1)
        self.dome = (dome.a, dome.b, dome.top)
        self.first = (-half_columns * spacing, -half_rows * spacing)
        self.x: Array = np.arange(-half_columns, half_columns + 1) * np.float64(spacing)
        self.y: Array = np.arange(-half_rows, half_rows + 1) * np.float64(spacing)
        x, y = self.x, self.y
        within = (x / dome.a) ** 2 + (y[:, None] / dome.b) ** 2 < 1.0
        self.d, self.rhs, self.left, self.before = (np.zeros(self.shape) for _ in range(4))
        self.obstacle = np.full(self.shape, kernels.FREE)
        self.span = np.zeros((len(y), 2), np.int64)
        rows = np.flatnonzero(within.any(axis=1))
        self.span[rows, 0] = within[rows].argmax(axis=1)
        self.span[rows, 1] = self.span[rows, 0] + within[rows].sum(axis=1)
        room = _ROOM * sum(self.shape) * 2
        self.near, self.face = np.ones((room, 4)), np.full((room, 4), kernels.FREE)
        self.far = np.ones((room, 4))
        self._kind = np.where(within, 0, -1).astype(np.int32)
        self._rim = self._mark_rim(dome, within, x, y)
        self.kind = self._kind.copy()

    def _mark_rim(self, dome: Dome, within: NDArray[np.bool_], x: Array, y: Array) -> int:
        """Number the nodes next to the rim and shorten their arms to it; returns how many there are."""
        i, j = np.nonzero(within)
        reach_x = dome.a * np.sqrt(1 - (y[i] / dome.b) ** 2)
        reach_y = dome.b * np.sqrt(1 - (x[j] / dome.a) ** 2)
        room = np.stack((reach_x + x[j], reach_x - x[j], reach_y + y[i], reach_y - y[i]), axis=1) / self.spacing
        near = (room < 1.0).any(axis=1)
        count = int(near.sum())
        self.far[:count] = np.clip(room[near], 1e-6, 1.0)
        self._kind[i[near], j[near]] = np.arange(1, count + 1)
        return count

    @property
    def arms(self) -> tuple[float, NDArray, NDArray, Array, Array, Array]:
        """What the kernels need of the nodes."""
        return self.spacing, self.kind, self.span, self.near, self.face, self.far

    def place(self, outline: Array, gap: float) -> None:
        """Lay the outline (N, 2) [m] of a face on it, whose plane is ``gap`` [m] below the apex."""
        self.kind[:] = self._kind
        kernels.place_outline(
            outline,
            gap,
            self.spacing,
            self.dome,
            self.first,
            self.kind,
            self._rim,
            self.obstacle,
            self.near,
            self.face,
            self.far,
        )


class Membrane:
    """A dome and its present deformation; `press` finds the next one from it."""

    def __init__(self, dome: Dome = DOME, spacing: float = 0.0008, tolerance: float = 5e-6):
        """``spacing`` [m] of the finest grid; ``tolerance`` [m] of a solution's last correction."""
        self.dome = dome
        self.tolerance = tolerance
        step = 2 ** (_LEVELS - 1)
        half_columns, half_rows = (step * ceil((r / spacing + 1) / step) for r in (self.dome.a, self.dome.b))
        self._levels = [_Level(self.dome, spacing * 2**n, half_rows >> n, half_columns >> n) for n in range(_LEVELS)]
        finest = self._levels[0]
        self._ghost = finest.d.copy()
        self._cells = np.zeros(finest.shape, np.uint8)
        self._outline = np.zeros((3, 2))
        self._face_height = self.dome.top
        #: κ∫d [1/m]: the gas's push over the membrane's tension
        self.load = 0.0
        self._share = 1.0
        #: cycles that the last `press` took
        self.cycles = 0

    @property
    def deformation(self) -> Array:
        """d (rows, columns) [m] at the nodes `x`, `y`, positive inward; a view."""
        return self._levels[0].d

    @property
    def x(self) -> Array:
        """Where the columns of `deformation` lie [m]."""
        return self._levels[0].x

    @property
    def y(self) -> Array:
        """Where the rows of `deformation` lie [m]."""
        return self._levels[0].y

    def release(self) -> None:
        """Let go of what was pressed: d = 0."""
        for level in self._levels:
            level.d[:] = 0.0
        self._ghost[:] = 0.0
        self._cells[:] = kernels.OUTSIDE
        self._face_height = self.dome.top
        self.load, self.cycles = 0.0, 0

    def press(self, outline: ArrayLike, indentation: float) -> None:
        """Press the face of a polygon, ``outline`` (N, 2) [m] over the rim's plane, ``indentation`` [m] into the apex.

        Raises ValueError for an indentation that is not between 0 and the dome's height.
        """
        if not 0 < indentation < self.dome.top:
            raise ValueError(f"indentation {indentation:g} m: expected one in (0, {self.dome.top:g}) m")
        self._outline = np.ascontiguousarray(outline, float)
        self._face_height = self.dome.top - indentation
        finest = self._levels[0]
        for level in self._levels:
            level.place(self._outline, indentation)
        np.maximum(finest.d, finest.obstacle, out=finest.d)
        for self.cycles in range(1, _MOST + 1):
            # at worst an arm's nearer end comes and goes with the correction: half of it ends that
            self._share = 1.0 if self.cycles <= _WHOLE else 0.5
            change = self._cycle(0, 0.0)
            if change < self.tolerance:
                break
        kernels.outer_values(finest.d, finest.obstacle, finest.span, self._ghost, self._cells)

    def _cycle(self, n: int, offset: float) -> float:
        """One V-cycle from level ``n``, whose volume is ``offset`` short; returns its correction [m]."""
        fine = self._levels[n]
        if n == _LEVELS - 1:
            self.load = kernels.settle(
                fine.d, fine.obstacle, fine.rhs, self.load, *fine.arms, self.dome.gas, offset, self.dome.feedback,
                60, 10 * self.tolerance * (abs(self.load) + 10)
            )  # fmt: skip
            return 0.0
        coarse = self._levels[n + 1]
        kernels.relax(fine.d, fine.obstacle, fine.rhs, self.load, *fine.arms, 2)
        kernels.residual(fine.d, fine.rhs, self.load, *fine.arms, fine.left)
        kernels.coarsen(fine.d, fine.left, self.load, *coarse.arms, fine.obstacle, coarse.d, coarse.before, coarse.rhs)
        offset += kernels.volume(fine.d, fine.spacing, fine.span)
        self._cycle(n + 1, offset - kernels.volume(coarse.d, coarse.spacing, coarse.span))
        change = kernels.correct(fine.d, fine.obstacle, fine.span, coarse.d, coarse.before, self._share)
        kernels.relax(fine.d, fine.obstacle, fine.rhs, self.load, *fine.arms, 2)
        return change

    def look(self, rays: tuple[Array, Array], reference: Array, base: float, shift: float, depth: Array) -> None:
        """Depth (rows, columns) [m] of the membrane along a camera's rays, into ``depth``, which starts the search.

        ``rays`` are the slopes (x per column, y per row) from a camera ``base`` [m] below the rim's plane, whose axis
        is ``shift`` [m] before the dome's along x. ``reference`` is the depth of the unpressed dome, NaN where a ray
        does not pass the rim; so is the result.
        """
        finest = self._levels[0]
        kernels.look(
            rays, reference, finest.d, self._ghost, self._cells, self._outline, self._face_height, finest.spacing,
            finest.dome, finest.first, base, shift, depth
        )  # fmt: skip

    def height(self, x: ArrayLike, y: ArrayLike) -> Array:
        """Height (...) [m] of the pressed membrane over (x, y) (...)."""
        finest = self._levels[0]
        px, py = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
        out = [
            kernels.surface(
                p, q, finest.d, self._ghost, self._cells, self._outline, self._face_height, finest.spacing,
                finest.dome, finest.first
            )
            for p, q in zip(px.ravel(), py.ravel(), strict=True)
        ]  # fmt: skip
        return np.array(out).reshape(px.shape)
