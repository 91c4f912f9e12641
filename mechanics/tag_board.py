"""A flat board of AprilTags in rows and columns: what a camera is calibrated with.

The board's frame B has its origin in the middle of the board, x to the right and y up as one reads the tags, and z out
of the printed side, toward the reader.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields

import numpy as np

from mechanics.camera import tag_corners
from mechanics.readings import Array

_CELLS = 8  # of a tag36h11, across its black square
_IDS = 587


@dataclass(frozen=True, slots=True)
class TagBoard:
    """``columns`` × ``rows`` tags (tag36h11) of edge ``size`` [m] of the black square, ``gap`` [m] between squares.

    Ids count from ``first_id``, left to right and then upward from the lowest row. White paper reaches one gap beyond
    the outer squares. Raises ValueError for a board that cannot be printed.
    """

    columns: int = 6
    rows: int = 4
    size: float = 0.03
    gap: float = 0.01
    first_id: int = 100

    def __post_init__(self) -> None:
        for name in ("columns", "rows", "first_id"):
            value = getattr(self, name)
            if not isinstance(value, int) or value < (name != "first_id"):
                raise ValueError(f"tag board {name}: expected a whole number that can be counted, got {value!r}")
        if not (math.isfinite(self.size) and self.size > 0):
            raise ValueError(f"tag board size: expected a length above 0, got {self.size!r}")
        if not (math.isfinite(self.gap) and self.gap >= 2 * self.size / _CELLS * (1 - 1e-9)):
            least = 2 * self.size / _CELLS
            raise ValueError(f"tag board gap: expected {least:g} m or more (two white cells), got {self.gap!r}")
        if self.first_id + self.columns * self.rows > _IDS:
            raise ValueError(f"tag board: {self.columns * self.rows} tags from id {self.first_id} go beyond id 586")

    @property
    def ids(self) -> tuple[int, ...]:
        """Ids of the tags, from the lower left."""
        return tuple(range(self.first_id, self.first_id + self.columns * self.rows))

    @property
    def half_size(self) -> tuple[float, float]:
        """Half the width and half the height [m] of the paper."""
        pitch = self.size + self.gap
        return (self.columns * pitch + self.gap) / 2, (self.rows * pitch + self.gap) / 2

    def centre(self, id: int) -> tuple[float, float]:
        """Middle (x, y) [m] of a tag in B. Raises ValueError for an id that is not on the board."""
        if id not in self.ids:
            raise ValueError(f"tag board: there is no tag {id}; expected {self.ids[0]} to {self.ids[-1]}")
        row, column = divmod(id - self.first_id, self.columns)
        pitch = self.size + self.gap
        return (column - (self.columns - 1) / 2) * pitch, (row - (self.rows - 1) / 2) * pitch

    def points(self) -> dict[int, Array]:
        """Corners (4, 3) [m] of each tag in B, in the order of `mechanics.readings.TagDetection`."""
        square = np.column_stack((tag_corners(self.size), np.zeros(4)))
        return {id: square + np.array([*self.centre(id), 0.0]) for id in self.ids}

    def as_dict(self) -> dict:
        """The board as JSON-serialisable values."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping) -> TagBoard:
        """Inverse of `as_dict`; what is missing is as usual. Raises ValueError for what is unknown or cannot be."""
        if not isinstance(values, Mapping):
            raise ValueError(f"tag board: expected a mapping, got {values!r}")
        unknown = sorted(set(map(str, values)) - {field.name for field in fields(cls)})
        if unknown:
            raise ValueError(f"tag board: unknown {', '.join(unknown)}")
        try:
            return cls(**values)
        except TypeError as error:
            raise ValueError(f"tag board: {error}") from None
