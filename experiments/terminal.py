"""The terminal as it is: with or without colour, UTF-8 and a person before it. The one place that knows.

Every stream of the command gets an error handler that writes what its encoding has not in ASCII (``±`` as ``+-``), so
that nothing that is printed can fail; consoles do the same before they lay out, so that columns stay columns.
"""

from __future__ import annotations

import codecs
import io
import os
import sys
import unicodedata
from collections.abc import Iterable
from typing import Any

import typer
from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from experiments.narrow import fits, stacked

#: columns from which on help is drawn in boxes
_BOXES = 80
_HANDLER = "extrinsic.ascii"
_ASCII = {
    "±": "+-", "µ": "u", "μ": "u", "°": " deg", "²": "2", "³": "3", "·": ".", "×": "x", "…": "...", "−": "-", "–": "-",
    "—": "-", "≤": "<=", "≥": ">=", "≈": "~", "→": "->", "§": "section ", "“": '"', "”": '"', "’": "'", "✓": "ok",
    "θ": "theta", "τ": "tau", "ρ": "rho", "σ": "sigma", "χ": "chi", "ε": "eps", "Δ": "d",
    "•": "*", "─": "-", "━": "-", "│": "|", "┃": "|", "╭": "+", "╮": "+", "╰": "+", "╯": "+",
}  # fmt: skip
"""What is written for a character that the terminal has not."""


def _in_ascii(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    letters = error.object[error.start : error.end]
    return "".join(_ASCII.get(letter) or _bare(letter) for letter in letters), error.end


def _bare(letter: str) -> str:
    """A letter without its accents, or a question mark."""
    return unicodedata.normalize("NFKD", letter).encode("ascii", "ignore").decode() or "?"


codecs.register_error(_HANDLER, _in_ascii)


def plain(text: str, encoding: str) -> str:
    """``text`` in what ``encoding`` has."""
    return text.encode(encoding, _HANDLER).decode(encoding)


class Terminal(Console):
    """A console whose text is of its stream's encoding before it is laid out, and whose tables can always be read."""

    def render_str(self, text: str, **options: Any) -> Text:
        """As `Console.render_str`."""
        encoding = self.encoding
        return super().render_str(text if encoding.startswith("utf") else plain(text, encoding), **options)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """As `Console.render`; a table with headings that is too wide comes as `experiments.narrow.stacked`."""
        if isinstance(renderable, Table) and renderable.show_header:
            renderable = renderable if fits(renderable, self, options or self.options) else stacked(renderable, self)
        return super().render(renderable, options)


def colourless() -> bool:
    """Whether the person wants no colours (https://no-color.org); no other ornament of text is used then either."""
    return os.environ.get("NO_COLOR", "") != ""


def terminal(*, stderr: bool = False, file_width: int | None = None, prose: bool = False) -> Console:
    """The console on standard output, or on standard error. Colours are for a terminal.

    ``file_width`` is its width [columns] where that is no terminal and $COLUMNS is not set. One for ``prose`` leaves
    breaking lines to the terminal, so that a command or a path can be copied whole, and colours no figures.
    """
    stream = sys.stderr if stderr else sys.stdout
    width = None if stream.isatty() or "COLUMNS" in os.environ else file_width
    colours = None if colourless() else "auto"
    return Terminal(stderr=stderr, width=width, color_system=colours, soft_wrap=prose, highlight=not prose)


def prepare(app: typer.Typer) -> None:
    """Have both streams of this process write anything, and the help of ``app`` as the terminal is; at the start."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.errors != "surrogateescape":
            stream.reconfigure(errors=_HANDLER)
    # the boxes of typer's help cut off what stands in them where there is no room
    app.rich_markup_mode = "rich" if terminal().width >= _BOXES else None
    if colourless():
        from typer import rich_utils

        rich_utils.COLOR_SYSTEM = None
