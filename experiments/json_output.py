"""What `--json FILE` writes: a file, made with its folder and never half there, or standard output for ``-``."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from rich.console import Console

from experiments.run_folder import write_json
from experiments.terminal import terminal
from mechanics.yaml_input import InputError, Problem

STDOUT = Path("-")


def put(where: Path | None, data: Any, *, line: bool = False) -> None:
    """As `write`. Raises InputError where the file cannot be written."""
    try:
        write(where, data, line=line)
    except OSError as error:
        wrong = f"cannot be written: {error.strerror}"
        raise InputError([Problem(str(where), None, "--json", wrong, "a place you may write to, or -")]) from None


def write(where: Path | None, data: Any, *, line: bool = False) -> None:
    """Write ``data``, if that was asked for; on standard output as one ``line``, where there will be more of them.

    Raises OSError where the file cannot be written.
    """
    if where == STDOUT:
        text = json.dumps(data, indent=None if line else 2, allow_nan=False)  # ASCII, whatever the terminal has
        sys.stdout.write(text + "\n")
        sys.stdout.flush()
    elif where is not None:
        where.parent.mkdir(parents=True, exist_ok=True)
        write_json(where, data)


def beside(where: Path | None, file_width: int | None = None) -> Console:
    """The console for people: on standard error where standard output carries JSON. ``file_width`` as in `terminal`."""
    return terminal(stderr=where == STDOUT, file_width=file_width)
