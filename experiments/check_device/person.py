"""The person beside the device, and how to do without one."""

from __future__ import annotations

import sys
from typing import Protocol

from rich.console import Console
from rich.text import Text


class Person(Protocol):
    """Whoever is asked. ``here`` says whether there is a hand that could press, push or touch."""

    here: bool

    def ready(self, request: str) -> bool:
        """Ask for something that is to be done from now on; False where it is not."""
        ...

    def confirm(self, question: str) -> bool:
        """Ask what is answered by yes or no."""
        ...


class Nobody:
    """No person; ``agreed`` is what they said beforehand of what would be confirmed."""

    here = False

    def __init__(self, agreed: bool = False):
        self._agreed = agreed

    def ready(self, request: str) -> bool:
        """Nobody does it."""
        del request
        return False

    def confirm(self, question: str) -> bool:
        """As agreed beforehand."""
        del question
        return self._agreed


class AtTerminal:
    """A person at the terminal."""

    here = True

    def __init__(self, console: Console):
        self._console = console

    def ready(self, request: str) -> bool:
        """Enter does it, ``s`` leaves the step out."""
        return not self._asked(f"{request}. Press Enter, or s to leave it out: ").startswith("s")

    def confirm(self, question: str) -> bool:
        """Anything but ``y`` is no."""
        return self._asked(f"{question} [y/N] ").startswith("y")

    def _asked(self, text: str) -> str:
        try:
            return self._console.input(Text(f"{'':13}{text}")).strip().lower()
        except EOFError:  # the terminal was closed: nobody says yes
            return "s"


def whoever_is_here(console: Console, *, yes: bool) -> Person:
    """The person at the terminal, unless there is no terminal, or ``yes`` was said beforehand."""
    return AtTerminal(console) if sys.stdin.isatty() and not yes else Nobody(agreed=yes)
