"""What a step of the checklist found: a measured figure and a verdict."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from drivers.errors import CommandRefused, DriverError


class Verdict(StrEnum):
    """``short``: not as it should be. ``failed``: the device did not do what was asked. ``skipped``: nobody looked."""

    GOOD = "good"
    SHORT = "short"
    SKIPPED = "skipped"
    FAILED = "failed"


@dataclass(frozen=True)
class Finding:
    """What was ``measured``, in words, and what that is worth; ``remedy`` is what a person can do.

    ``figures`` are the numbers behind the words, by name with their unit.
    """

    verdict: Verdict
    measured: str
    remedy: str = ""
    figures: dict[str, Any] = field(default_factory=dict)


def judged(good: bool, measured: str, remedy: str = "", **figures: Any) -> Finding:
    """A finding that is good or short; the remedy belongs to the latter."""
    return Finding(Verdict.GOOD if good else Verdict.SHORT, measured, "" if good else remedy, figures)


def skipped(why: str) -> Finding:
    """Nobody looked, and why."""
    return Finding(Verdict.SKIPPED, why)


def of_error(error: DriverError) -> Finding:
    """What an error of the device is worth: a refusal is no failure."""
    verdict = Verdict.SHORT if isinstance(error, CommandRefused) else Verdict.FAILED
    return Finding(verdict, f"{error.asked}: {error.got}", error.remedy)
