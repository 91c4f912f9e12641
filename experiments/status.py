"""`extrinsic status`: a station's devices once, or watched until somebody has seen enough."""

from __future__ import annotations

import json
import os
import select
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.text import Text

from drivers.config import StationConfig
from drivers.errors import DriverError
from drivers.status import DeviceStatus, how_to_start, station_certificates, station_status
from drivers.status_watch import LOOKING, StationWatch
from experiments.exit_codes import ExitCode
from experiments.interrupt import Interrupt
from experiments.json_output import STDOUT, beside, put
from experiments.progress import outlive_terminal
from experiments.tables import status_table
from experiments.terminal import terminal
from mechanics.yaml_input import InputError, Problem

#: how often a watched station is shown [s], to a person and to a file
ON_TERMINAL, IN_FILE = 0.5, 10.0
#: what a person presses to end it
_ENDS = ("q", "Q", "\x03", "\x04")
#: certificates age by the day [s]
_CERTIFICATES = 60.0

Certificates = Sequence[tuple[str, int]]


def once(config: StationConfig, json_file: Path | None) -> ExitCode:
    """Show a station as it is now; the exit code says whether every device is alive."""
    rows, certificates = station_status(config), station_certificates(config)
    console = beside(json_file)
    console.print(status_table(rows, certificates, width=console.width))
    put(json_file, as_json(config, rows, certificates))
    alive = [row.alive for row in rows]
    if not any(alive):
        terminal(stderr=True).print(how_to_start(config), soft_wrap=True, highlight=False, markup=False)
    return ExitCode.DONE if all(alive) else ExitCode.DEVICE_FAILED


def as_json(config: StationConfig, rows: Sequence[DeviceStatus], certificates: Certificates) -> dict[str, Any]:
    """What `--json` writes of one look, a versioned contract: docs/command-line.md. SI; null where nothing is known."""
    devices: list[dict[str, Any]] = []
    for row in rows:
        arm = None if row.arm is None else asdict(row.arm)
        figures = {"rate_Hz": row.rate, "age_s": row.age, "gaps": row.gaps}
        said = {"model": row.model, "condition": row.condition, "trouble": row.trouble, "arm": arm}
        devices.append(
            {"name": row.name, "kind": row.kind, "backend": row.backend, "alive": row.alive} | figures | said
        )
    return {
        "schema": 1,
        "time": _now(),
        "station": config.name,
        "endpoint": config.bus.endpoint,
        "alive": all(row.alive for row in rows),
        "devices": devices,
        "certificates": [{"name": name, "days_left": days} for name, days in certificates],
    }


def watch(config: StationConfig, interval: float | None, json_file: Path | None) -> ExitCode:
    """Show a station until Ctrl-C, `q` or SIGTERM, every ``interval`` [s]: whether it runs or not, now or later.

    On a terminal one picture that changes; elsewhere a plain line for each device, or one line of JSON.
    Raises InputError for JSON into a file, which would be written again and again.
    """
    if json_file not in (None, STDOUT):
        expected = "--json - : one line for each look, on standard output"
        raise InputError([Problem("status", None, "--json", "a watched station has no single answer", expected)])
    console = terminal()
    live = console.is_terminal and not console.is_dumb_terminal and json_file is None
    outlive_terminal(console)
    period = interval or (ON_TERMINAL if live else IN_FILE)
    with Interrupt("closing") as interrupt, StationWatch(config) as looking:
        try:
            if live:
                _live(config, looking, period, console)
            else:
                _lines(config, looking, period, json_file, interrupt)
        except KeyboardInterrupt:
            pass
        interrupt.closing()
    return ExitCode.DONE


def _live(config: StationConfig, looking: StationWatch, period: float, console: Console) -> None:
    """The picture, on a screen of its own; the last one stays behind when that is left."""
    certificates, read = station_certificates(config), time.monotonic()
    last: RenderableType = ""
    try:
        with _keys() as pressed, Live(console=console, screen=True, auto_refresh=False) as live:
            while True:
                if time.monotonic() - read > _CERTIFICATES:
                    with suppress(DriverError):  # a new one is just being copied there
                        certificates = station_certificates(config)
                    read = time.monotonic()
                last = _picture(config, looking.look(), certificates, console.width)
                live.update(last, refresh=True)
                if pressed(period) in _ENDS:
                    return
    finally:
        console.print(last)


def _picture(config: StationConfig, rows: Sequence[DeviceStatus], certificates: Certificates, width: int) -> Group:
    alive = sum(row.alive for row in rows)
    stopped = [f"{row.name} is stopped: {row.arm.stopped}" for row in rows if row.arm is not None and row.arm.stopped]
    head = Text.assemble((config.name, "bold"), f" at {config.bus.endpoint}: {alive} of {len(rows)} devices alive")
    said = [Text(text, "bold red") for text in stopped]
    if stopped:
        said.append(Text("once its reason is gone: `extrinsic recover STATION`"))
    elif not alive and not all(row.trouble == LOOKING for row in rows):
        said.append(Text(how_to_start(config)))
    foot = Text(f"{datetime.now():%H:%M:%S}; q or Ctrl-C ends it", "dim")
    return Group(head, status_table(rows, certificates, width=width, models=False), *said, foot)


def _lines(
    config: StationConfig, looking: StationWatch, period: float, json_file: Path | None, interrupt: Interrupt
) -> None:
    waiting = threading.Event()
    waiting.wait(min(period, 1.5))  # the first look has something to see
    while True:
        interrupt.check()
        rows = looking.look()
        if json_file is not None:
            put(json_file, as_json(config, rows, station_certificates(config)), line=True)
        else:
            sys.stdout.write("".join(line(row) + "\n" for row in rows))
            sys.stdout.flush()
        waiting.wait(period)


def line(row: DeviceStatus) -> str:
    """A device in a log: the time, the name, then words of which each says what it is."""
    figures = (
        ("rate_Hz", None if row.rate is None else f"{row.rate:.1f}"),
        ("age_s", None if row.age is None else f"{row.age:.2f}"),
        ("gaps", None if row.gaps is None else str(row.gaps)),
        ("note", json.dumps("; ".join(row.notes), ensure_ascii=False) if row.notes else None),
    )
    known = "".join(f" {name}={text}" for name, text in figures if text is not None)
    return f"{_now()} {row.name} {'alive' if row.alive else 'absent'}{known}"


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


@contextmanager
def _keys() -> Iterator[Any]:
    """Keys as they are pressed: ``pressed(seconds)`` waits at most so long, and returns "" where none was.

    The terminal is as before afterwards. Where standard input is no terminal nobody presses anything.
    """
    nobody = threading.Event()
    if not sys.stdin.isatty():
        yield lambda seconds: str(nobody.wait(seconds) or "")
        return
    import termios
    import tty

    file = sys.stdin.fileno()
    before = termios.tcgetattr(file)

    def pressed(seconds: float) -> str:
        if not select.select([file], [], [], seconds)[0]:
            return ""
        try:
            return os.read(file, 1).decode(errors="replace") or _ENDS[-1]
        except OSError:  # the terminal was closed
            return _ENDS[-1]

    try:
        tty.setcbreak(file, termios.TCSADRAIN)
        yield pressed
    finally:
        termios.tcsetattr(file, termios.TCSADRAIN, before)
