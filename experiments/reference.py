"""The reference of commands and options, from the command itself: the end of docs/command-line.md.

``python -m experiments.reference`` prints it.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Any

from typer.main import get_command


def commands() -> Iterator[tuple[str, Any]]:
    """Every command that can be called, with what typer made of it: ``lab init`` after ``lab``'s own place."""
    from experiments.cli import app

    yield from _below("", get_command(app))


def _below(prefix: str, group: Any) -> Iterator[tuple[str, Any]]:
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from _below(f"{prefix}{name} ", command)
        else:
            yield prefix + name, command


def options(command: Any) -> list[tuple[str, str]]:
    """The options of a command, as they are written, each with what it does; ``--help`` is everywhere and left out."""
    found: list[tuple[str, str]] = []
    for parameter in command.params:
        if parameter.param_type_name == "option" and "--help" not in parameter.opts:
            metavar = "" if parameter.is_flag else f" {parameter.metavar or 'N'}"
            found.append((max(parameter.opts, key=len) + metavar, parameter.help or ""))
    return found


def arguments(command: Any) -> str:
    """The arguments of a command as one writes them; in brackets what may be left out."""
    words: list[str] = []
    for parameter in command.params:
        if parameter.param_type_name == "argument":
            word = (parameter.metavar or parameter.name.upper()).strip("[].")
            word += " ..." if parameter.nargs == -1 else ""
            words.append(word if parameter.required else f"[{word}]")
    return " ".join(words)


def markdown() -> str:
    """The reference: a section for each command with its example and a table of its options."""
    parts: list[str] = []
    for name, command in commands():
        usage = " ".join(filter(None, ("extrinsic", name, arguments(command))))
        said = command.help.strip().splitlines()[0]
        example = (command.epilog or "").removeprefix("Example: ")
        parts += [f"### `{usage}`", "", f"{said} Example: `{example}`", ""]
        told = options(command)
        if told:
            parts += ["| option | what it does |", "|---|---|"]
            parts += [f"| `{option}` | {_cell(text)} |" for option, text in told]
            parts.append("")
    return "\n".join(parts)


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


if __name__ == "__main__":
    sys.stdout.write(markdown())
