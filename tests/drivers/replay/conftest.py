"""Logs that are made by hand, and what must not be left behind."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from drivers.interfaces import Description
from drivers.wire.bus import open_buses
from drivers.wire.log import LogWriter
from tests.drivers.replay.tape import DEVICES, Tape


@pytest.fixture
def record(tmp_path: Path) -> Callable[..., Path]:
    """Make a log: ``record(say, name)`` has ``say`` fill a tape whose devices are described."""

    def make(
        say: Callable[[Tape], object],
        name: str = "log.mcap",
        devices: dict[str, Description] | None = DEVICES,
        lockstep: bool = False,
    ) -> Path:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with LogWriter(path) as log:
            tape = Tape(log)
            if devices is not None:
                tape.describe(devices, lockstep=lockstep)
            say(tape)
        return path

    return make


@pytest.fixture(autouse=True)
def nothing_is_left_running() -> Iterator[None]:
    """A recording that was closed has no thread, and a bus no session."""
    yield
    assert not open_buses()
    stray = [thread.name for thread in threading.enumerate() if thread.name.startswith("play ")]
    assert not stray, f"threads were left running: {stray}"
