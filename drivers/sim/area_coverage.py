"""Shapes laid over a picture so that each pixel is the mean over its square, exactly: the loops, compiled.

Every segment of a boundary is cut at the pixel grid, and the signed area beside each piece summed along the rows
(Green's theorem).
"""

from __future__ import annotations

from math import ceil, floor

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy")
def lay(grey, start, end, level, cover, x0, y0, x1, y1):
    """Lay a shape over the window [x0, x1) × [y0, y1) of the picture ``grey`` (h, w).

    Across each directed segment ``start`` → ``end`` (n, 2) [px] the shape's grey level, times its cover, rises by
    ``level`` (n,) and the share that it covers by ``cover`` (n,). Pixel (i, j) covers [j ± ½] × [i ± ½].
    """
    height, width = y1 - y0, x1 - x0
    levels, covers = np.zeros((height, width + 2)), np.zeros((height, width + 2))
    for n in range(len(start)):
        sx, sy = start[n, 0] + 0.5 - x0, start[n, 1] + 0.5 - y0
        dx, dy = end[n, 0] + 0.5 - x0 - sx, end[n, 1] + 0.5 - y0 - sy
        if dy == 0:
            continue
        # the grid's lines that it meets next, and which way they go on
        column_line, to_column = (floor(sx) + 1, 1) if dx > 0 else (ceil(sx) - 1, -1)
        row_line, to_row = (floor(sy) + 1, 1) if dy > 0 else (ceil(sy) - 1, -1)
        t = 0.0
        while t < 1.0:
            at_column = (column_line - sx) / dx if dx != 0 else 1.0
            at_row = (row_line - sy) / dy
            until = min(at_column, at_row, 1.0)
            drop = (until - t) * dy  # signed height of this piece, which lies within one pixel
            middle = 0.5 * (t + until)
            row = floor(sy + middle * dy)
            if 0 <= row < height:
                # what lies left of the window still covers all of its row, what lies right nothing
                x = min(max(sx + middle * dx, 0.0), float(width))
                column = int(x)
                right = drop * (x - column)
                levels[row, column] += level[n] * (drop - right)
                levels[row, column + 1] += level[n] * right
                covers[row, column] += cover[n] * (drop - right)
                covers[row, column + 1] += cover[n] * right
            if at_column <= until:
                column_line += to_column
            if at_row <= until:
                row_line += to_row
            t = until
    for i in range(height):
        value = share = 0.0
        for j in range(width):
            value += levels[i, j]
            share += covers[i, j]
            grey[y0 + i, x0 + j] = grey[y0 + i, x0 + j] * (1 - share) + value


def warm() -> None:
    """Compile the loop, or load it from the cache."""
    square = np.array([[1.0, 1.0], [1.0, 3.0], [3.0, 3.0], [3.0, 1.0]])
    ones = np.ones(4)
    lay(np.zeros((5, 5)), square, np.roll(square, -1, axis=0), ones, ones, 0, 0, 5, 5)
