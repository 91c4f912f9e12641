"""Tables on a terminal that is too narrow for them: a block of lines for each row, and nothing cut off."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import zip_longest

from rich.console import Console, ConsoleOptions, Group, RenderableType
from rich.measure import Measurement
from rich.padding import Padding
from rich.table import Column, Table
from rich.text import Text

#: a column whose words may go on in the next line has to have this width at least
_READABLE = 14


def fits(table: Table, console: Console, options: ConsoleOptions) -> bool:
    """Whether every column of a ``table`` can be read in the width that there is."""
    _, right, _, left = table.padding
    edges = 0 if table.box is None else len(table.columns) - 1 + (2 if table.show_edge else 0)
    room = options.max_width - edges - len(table.columns) * (left + right)
    return sum(_wanted(column, console, options) for column in table.columns) <= room


def _wanted(column: Column, console: Console, options: ConsoleOptions) -> int:
    wide = options.update(width=10_000)
    cells = [column.header, *column.cells]
    width = max((Measurement.get(console, wide, cell).maximum for cell in cells), default=0)
    return width if column.no_wrap else min(width, _READABLE)


def stacked(table: Table, console: Console) -> Group:
    """Each row by itself: its first cell, and below it what the other columns say, a line for each.

    What stands below each other in a cell comes to stand beside each other.
    """
    blocks: list[RenderableType] = []
    if table.title:
        blocks.append(_text(table.title, console))
    heads = [_text(column.header, console) for column in table.columns]
    for row, *cells in zip(table.rows, *(column.cells for column in table.columns), strict=True):
        style = row.style or ""
        first = Text(" ").join(_text(cells[0], console).split())
        if first:
            blocks.append(Text.assemble(first, style=style))
        lines = _lines(heads[1:], cells[1:], console)
        block = Table.grid(*(Column(overflow="fold") for _ in next(iter(lines), ())), padding=(0, 1, 0, 0))
        block.style = style
        for line in lines:
            block.add_row(*line)
        blocks.append(Padding(block, (0, 0, 0, 2)))
    return Group(*blocks)


def _lines(heads: Sequence[Text], cells: Sequence[RenderableType], console: Console) -> list[tuple[Text, ...]]:
    """The lines of a block: a heading, then the lines of its cell. What is empty is left out."""
    told = [
        [Text(" ").join(head.split()), *_text(cell, console).split()] for head, cell in zip(heads, cells, strict=True)
    ]
    told = [line for line in told if any(part.plain.strip() for part in line[1:])]
    return list(zip(*zip_longest(*told, fillvalue=Text()), strict=True))


def _text(cell: RenderableType, console: Console) -> Text:
    if isinstance(cell, Text):
        return cell
    if isinstance(cell, str):
        return console.render_str(cell)
    with console.capture() as captured:
        console.print(cell)
    return Text(captured.get().rstrip())
