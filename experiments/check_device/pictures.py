"""Whether there is light enough in a picture, and not too much."""

from __future__ import annotations

from numpy.typing import NDArray

#: mean grey levels between which a picture is neither dark nor bright, and the largest share of burnt pixels
DARK, BRIGHT, BURNT = 25.0, 230.0, 0.2


def exposure(grey: NDArray) -> tuple[str, bool, str]:
    """Of a grey picture (h, w) uint8: what was found in words, whether it is well, and what helps."""
    mean, burnt = float(grey.mean()), float((grey >= 254).mean())
    words = f"brightness {mean:.0f} of 255, {burnt:.1%} burnt out"
    if mean < DARK:
        return words, False, "More light, or a longer exposure"
    if mean > BRIGHT or burnt > BURNT:
        return words, False, "Less light, or a shorter exposure"
    return words, True, ""
