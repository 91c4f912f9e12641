"""What a planner can say when there is no plan."""

from __future__ import annotations

import math


class InfeasiblePlan(Exception):
    """No admissible force does what was asked.

    Fields: ``step`` (from 0), ``contact`` (its name), ``by`` (the body that it touches), ``need`` and ``have`` (the
    friction coefficients), ``reason`` (set where friction is not what is missing).
    """

    def __init__(
        self, step: int, contact: str, need: float, have: float, by: str = "ground", reason: str | None = None
    ):
        self.step, self.contact, self.need, self.have, self.by, self.reason = step, contact, need, have, by, reason
        super().__init__(step, contact, need, have, by, reason)

    def __str__(self) -> str:
        named = self.by in self.contact.split()  # "ground left" says by itself what it touches
        place = (
            f"{self.contact}, step {self.step}: "
            if named
            else f"{self.by} contact '{self.contact}', step {self.step}: "
        )
        if self.reason is not None:
            return place + self.reason
        if not math.isfinite(self.need):
            return place + "the desired force pulls, and a contact only pushes: ask for a positive normal force"
        return (
            f"{place}needs µ ≥ {self.need:.3g}, has {self.have:.3g}:"
            " ask for less tangential force, or state the friction that the pair really has"
        )
