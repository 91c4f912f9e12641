"""What somebody who waits is shown."""

import io

import pytest
from rich.console import Console
from rich.progress import Task

from experiments import bench
from experiments.progress import Progress, _ByTheClock


def task_after(elapsed: float) -> Task:
    clock = iter((0.0, elapsed))
    task = Task(0, "bench load", None, 0.0, _get_time=lambda: next(clock))  # type: ignore[arg-type]
    task.start_time = next(clock)
    return task


@pytest.mark.parametrize(
    ("elapsed", "said"), [(0.0, "21:00 left"), (1195.0, "1:05 left"), (1259.2, "0:01 left"), (1400.0, "any moment")]
)
def test_what_takes_a_known_time_tells_what_is_left_of_it(elapsed: float, said: str) -> None:
    assert _ByTheClock(1260.0).render(task_after(elapsed)).plain == said


def test_it_is_shown_on_a_terminal_and_not_in_a_file() -> None:
    shown, kept = (Console(file=io.StringIO(), force_terminal=terminal, width=80) for terminal in (True, False))
    for console in (shown, kept):
        with Progress(console).step("bench load", 1260.0):
            pass
    assert "21:00 left" in shown.file.getvalue()  # type: ignore[attr-defined]
    assert kept.file.getvalue() == "bench load ...\n"  # type: ignore[attr-defined]


def test_benchmarks_of_a_set_time_know_it() -> None:
    known = {name: bench._seconds(name, bench.Options(minutes=1.0)) for name in ("load", "bus")}
    assert 60 < (known["load"] or 0) < 180
    assert 120 < (known["bus"] or 0) < 240
    assert bench._seconds("planning", bench.Options()) is None
