"""What an identification refuses to answer, as types with fields."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from mechanics.readings import Array


class FitError(ValueError):
    """Data from which a model cannot be identified.

    Fields: ``what`` (the quantity), ``expected``, ``received``, ``remedy`` (what the user can do).
    """

    def __init__(self, what: str, expected: str, received: str, remedy: str):
        self.what, self.expected, self.received, self.remedy = what, expected, received, remedy
        super().__init__(what, expected, received, remedy)

    def __str__(self) -> str:
        return f"{self.what}: expected {self.expected}, received {self.received}. {self.remedy}"


def finite_rows(what: str, values: ArrayLike, shape: tuple[int, ...], axes: tuple[str, ...] = ()) -> Array:
    """``values`` (n, *shape) as floats. Raises FitError for another shape, or where a number is not finite.

    ``axes`` names the last axis, for the message.
    """
    array = np.asarray(values, np.float64)
    if array.ndim != len(shape) + 1 or array.shape[1:] != shape:
        spelled = ", ".join(map(str, shape))
        raise FitError(what, f"shape (n, {spelled})", f"{array.shape}", "Pass one row per sample.")
    bad = np.argwhere(~np.isfinite(array))
    if len(bad):
        axis = f" ({axes[bad[0, -1]]})" if axes else ""
        rows = len(np.unique(bad[:, 0]))
        raise FitError(
            what,
            "finite numbers",
            f"NaN or infinity in {rows} of {len(array)} rows, first in row {bad[0, 0]}{axis}",
            "Leave out the readings whose status is not OK.",
        )
    return array
