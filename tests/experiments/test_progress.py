"""What somebody who waits is shown."""

import io

import pytest
from rich.console import Console
from rich.progress import Task

from experiments import bench
from experiments.bench.figures import Figure, Part, in_parts
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


def test_a_share_that_is_told_seldom_tells_the_time_left_too() -> None:
    now = [0.0]
    console = Console(file=io.StringIO(), force_terminal=True, width=80, get_time=lambda: now[0])
    with Progress(console).share("bench planning") as heard:
        now[0] = 120.0
        heard(0.25)  # so the rest takes three times as long
    shown = console.file.getvalue()  # type: ignore[attr-defined]
    assert "25%" in shown and ("0:06:00" in shown or "0:06:01" in shown)


def test_the_parts_of_a_benchmark_count_by_the_time_they_take() -> None:
    done = Figure("a", 1.0, 1.0, 1.0, "s", 1)
    shares: list[float] = []
    parts: list[Part] = [(1.0, lambda: [done]), (6.0, lambda: iter([done, done])), (3.0, lambda: [])]
    seen = [len(shares) for _ in in_parts(parts, shares.append)]
    assert seen == [0, 1, 1], "a share is told when its part is done"
    assert shares == pytest.approx([0.1, 0.7, 1.0])


def test_benchmarks_of_a_set_time_know_it() -> None:
    known = {name: bench._seconds(name, bench.Options(minutes=1.0)) for name in ("load", "bus")}
    assert 60 < (known["load"] or 0) < 180
    assert 120 < (known["bus"] or 0) < 240
    assert bench._seconds("planning", bench.Options()) is None
