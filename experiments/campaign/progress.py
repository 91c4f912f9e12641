"""Progress of a campaign with time left on a terminal, a plain line for each job elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.markup import escape

from experiments.progress import counted

Tell = Callable[[str], None]


@contextmanager
def progress(console: Console, total: int, done: int = 0) -> Iterator[Tell]:
    """``total`` jobs, ``done`` of them before; call what is yielded with a word on each that ends."""
    if done:
        console.print(f"{done} of {total} jobs are done already")
    if console.is_terminal:
        # a job may take minutes: the speed is that of the whole campaign, not of the last half minute
        with counted(console, speed_over=24 * 3600.0) as bars:
            task = bars.add_task("jobs", total=total, completed=done)

            def advance(word: str) -> None:
                bars.advance(task)
                if word:
                    bars.console.print(escape(word), highlight=False)

            yield advance
        return
    begin, count = time.monotonic(), 0

    def line(word: str) -> None:
        nonlocal count
        count += 1
        left = (time.monotonic() - begin) / count * (total - done - count)
        told = f": {word}" if word else ""
        console.print(f"{done + count} of {total} jobs, {duration(left)} left{told}", highlight=False, markup=False)

    yield line


def duration(seconds: float) -> str:
    """A time in the unit that a person would use."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
