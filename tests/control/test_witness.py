"""The second witness: forces balanced by hand on a table that a sensor carries."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from control.witness import TableWitness
from mechanics.readings import Stamp, Status, WrenchReading

S = 1_000_000_000
BIAS = np.array([0.4, 0.1, -0.7, 0.02, 0.03, 0.0])
#: of the wrist's force [N²]
COVARIANCE = np.diag([0.02, 0.02]) ** 2
HELD, STANDING = 1.0, 5.0


class Table:
    """A sensor whose x is W's x and whose z is up, which reads ``push`` (2,) [N] and its own bias."""

    def __init__(self, angle: float = 0.0):
        self.angle, self.push, self.status = angle, np.zeros(2), Status.OK

    def since(self, capture_ns: int) -> list[WrenchReading]:
        c, s = np.cos(self.angle), np.sin(self.angle)
        x, y = c * self.push[0] + s * self.push[1], -s * self.push[0] + c * self.push[1]
        reading = BIAS + np.array([x, 0.0, y, 0.0, 0.0, 0.0])
        return [
            WrenchReading(Stamp(capture_ns + i, capture_ns + i, i, "table_ft", self.status), reading)
            for i in range(1, 101)
        ]


def witness(table: Any, angle: float = 0.0) -> TableWitness:
    return TableWitness(table, np.array([0.1, -0.05, angle]), HELD, STANDING, S // 10)


@pytest.mark.parametrize("angle", [0.0, 0.7])
def test_what_the_fingers_push_down_and_what_stands_there_is_what_the_table_bears(angle: float) -> None:
    table = Table(angle)
    made = witness(table, angle)
    table.push = np.array([0.0, -STANDING])
    assert made.zero(S)
    # the fingers push the go with (1, −3) N, it weighs 1 N, and 5 N stand there as before
    table.push = np.array([1.0, -4.0 - STANDING])
    found = made.compare(2 * S, np.array([1.0, -3.0, 0.2]), COVARIANCE)
    assert found is not None and found.agrees
    assert found.difference == pytest.approx([0.0, 0.0], abs=1e-9)


def test_an_object_that_is_lifted_off_the_table_is_not_missed() -> None:
    # the go carries the other object away: the fingers bear its weight, and the table nothing
    table = Table()
    made = witness(table)
    table.push = np.array([0.0, -STANDING])
    made.zero(S)
    table.push = np.zeros(2)
    found = made.compare(2 * S, np.array([0.0, HELD + STANDING, 0.0]), COVARIANCE)
    assert found is not None and found.agrees and found.difference == pytest.approx([0.0, 0.0], abs=1e-9)


def test_a_force_that_only_one_of_them_feels_is_a_disagreement() -> None:
    table = Table()
    made = witness(table)
    table.push = np.array([0.0, -STANDING])
    made.zero(S)
    table.push = np.array([0.3, -4.0 - STANDING])
    found = made.compare(2 * S, np.array([0.0, -3.0, 0.0]), COVARIANCE)
    assert found is not None and not found.agrees
    assert found.difference == pytest.approx([-0.3, 0.0])


def test_long_after_the_zero_the_same_difference_may_be_drift() -> None:
    table = Table()
    made = witness(table)
    table.push = np.array([0.0, -STANDING])
    made.zero(S)
    table.push = np.array([0.3, -4.0 - STANDING])
    found = made.compare(1000 * S, np.array([0.0, -3.0, 0.0]), COVARIANCE)
    assert found is not None and found.agrees


def test_a_sensor_that_says_nothing_it_can_be_trusted_in_says_nothing() -> None:
    table = Table()
    made = witness(table)
    assert made.compare(S, np.zeros(3), COVARIANCE) is None  # it was never zeroed
    made.zero(S)
    assert made.compare(S, np.array([np.nan, 0.0, 0.0]), COVARIANCE) is None
    table.status = Status.SATURATED
    assert made.compare(S, np.zeros(3), COVARIANCE) is None
    assert not made.zero(2 * S)
    table.status = Status.OK
    assert made.compare(S, np.zeros(3), COVARIANCE) is None  # the old zero is not held on to
