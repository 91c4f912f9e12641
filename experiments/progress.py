"""Progress with time left on a terminal, plain lines elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import IO, Any, cast

from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    ProgressColumn,
    SpinnerColumn,
    Task,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.progress import Progress as Bars
from rich.text import Text

STYLES = {"info": "", "warning": "yellow", "error": "red"}

Heard = Callable[[float], None]
"""What is told the share, from 0 to 1, of something long that is done."""


#: the speed of something whose share is told counts from its beginning: it may be told seldom [s]
_WHOLE = 86400.0


def unheard(share: float) -> None:
    """Where nobody waits for it."""


def counted(console: Console, speed_over: float = 30.0) -> Bars:
    """Bars of things that are counted, with the time left by the speed over the last ``speed_over`` seconds."""
    return Bars(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=console,
        speed_estimate_period=speed_over,
    )


class _ByTheClock(ProgressColumn):
    """How long something is still going to take that takes ``seconds``, whatever it tells of itself."""

    def __init__(self, seconds: float):
        super().__init__()
        self._seconds = seconds

    def render(self, task: Task) -> Text:
        """The time left, or that it should be over by now."""
        left = round(self._seconds - (task.elapsed or 0.0))
        return Text(f"{left // 60}:{left % 60:02d} left" if left > 0 else "any moment", style="progress.remaining")


class _Steady:
    """A stream that takes what is written whether anybody is left to read it or not."""

    def __init__(self, file: IO[str]):
        self._file = file

    def write(self, text: str) -> int:
        """Write ``text`` if that is possible."""
        with suppress(OSError, ValueError):
            self._file.write(text)
        return len(text)

    def flush(self) -> None:
        """Flush if that is possible."""
        with suppress(OSError, ValueError):
            self._file.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


def outlive_terminal(console: Console) -> None:
    """Let ``console`` go on when its terminal is closed, or the pipe behind it: a run has to end in order."""
    if not isinstance(console.file, _Steady):
        console.file = cast("IO[str]", _Steady(console.file))


class Progress:
    """Shows what a run is doing on ``console``."""

    def __init__(self, console: Console):
        self.console = console

    @contextmanager
    def step(self, what: str, seconds: float | None = None) -> Iterator[None]:
        """One thing that tells nothing of itself; ``seconds`` where it is known how long it takes."""
        if not self.console.is_terminal:
            self.console.print(f"{escape(what)} ...")
            yield
            return
        spinner = SpinnerColumn("line" if self.console.options.ascii_only else "dots")
        columns = [spinner, TextColumn("{task.description}"), TimeElapsedColumn()]
        columns += [] if seconds is None else [_ByTheClock(seconds)]
        with Bars(*columns, console=self.console) as bars:
            bars.add_task(escape(what), total=None)
            yield

    @contextmanager
    def steps(self, what: str, total: int) -> Iterator[Callable[[], None]]:
        """``total`` things; call what is yielded after each."""
        if not self.console.is_terminal:
            self.console.print(f"{escape(what)} ({total} waypoints) ...")
            yield lambda: None
            return
        with counted(self.console) as bars:
            task = bars.add_task(escape(what), total=total)
            yield lambda: bars.advance(task)

    @contextmanager
    def share(self, what: str) -> Iterator[Heard]:
        """One thing whose progress is a share from 0 to 1; call what is yielded with it."""
        if not self.console.is_terminal:
            yield unheard
            return
        columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TextColumn("left"))
        with Bars(*columns, TimeRemainingColumn(), console=self.console, speed_estimate_period=_WHOLE) as bars:
            task = bars.add_task(escape(what), total=1.0)
            bars.update(task, completed=1e-9)  # the first point of its speed
            yield lambda share: bars.update(task, completed=share)

    def say(self, level: str, text: str) -> None:
        """One line to the person."""
        self.console.print(f"{level}: {escape(text)}", style=STYLES.get(level, ""))
