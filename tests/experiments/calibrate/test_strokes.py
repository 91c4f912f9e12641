"""Strokes that friction is found from: what cannot tell anything is refused before anything moves."""

from typing import Any

import pytest

from estimation.errors import FitError
from experiments.calibrate.strokes import Stroke, stroked

NOBODY: Any = None


@pytest.mark.parametrize(("length", "speed"), [(0.001, 0.02), (0.015, 0.2)])
def test_a_stroke_too_short_or_too_fast_to_move_evenly_is_refused(length: float, speed: float) -> None:
    stroke = Stroke(tilt=0.3, force=4.0, begin=-length / 2, end=length / 2)
    with pytest.raises(FitError, match="even motion"):
        stroked(NOBODY, NOBODY, stroke, speed)
