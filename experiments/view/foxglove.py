"""The layout for Foxglove that is shipped: it opens the logs as they are."""

from __future__ import annotations

from pathlib import Path

from experiments.run_folder import write_atomic
from mechanics.yaml_input import InputError, Problem

SHIPPED = Path(__file__).parent.parent / "foxglove_layout.json"
"""For the station that is shipped; its topics begin with `STATION`."""

STATION = "sim"


def text(station: str | None = None) -> str:
    """The layout as JSON, for another station's topics where one is named."""
    shipped = SHIPPED.read_text(encoding="utf-8")
    # in message paths the topic stands in quotes, for it has no leading slash
    return shipped if station is None else shipped.replace(f'"{STATION}/', f'"{station}/')


def write(path: Path, station: str | None = None) -> None:
    """Write the layout to a new file. Raises InputError where there is one already, or where it cannot be written."""
    if path.exists():
        raise InputError([Problem(str(path), None, "--foxglove-layout", "it is there already", "a new file")])
    try:
        write_atomic(path, text(station))
    except OSError as error:
        wrong = f"it cannot be written: {error.strerror}"
        raise InputError([Problem(str(path), None, "--foxglove-layout", wrong, "a folder you may write to")]) from None
