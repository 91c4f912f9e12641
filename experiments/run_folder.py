"""The run folder: what a run leaves behind, written so that a half file never lies there."""

from __future__ import annotations

import json
import os
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from drivers.wire.log_repair import to_read, written_logs
from mechanics.yaml_input import InputError, Problem


class RunFolder:
    """``runs/<experiment>-<UTC time>/`` with experiment.yaml, log.mcap, results.json, report.html and events.jsonl."""

    def __init__(self, path: Path):
        self.path = path
        self.experiment = path / "experiment.yaml"
        self.log = path / "log.mcap"
        self.results = path / "results.json"
        self.report = path / "report.html"
        self.events = path / "events.jsonl"
        self.calibration = path / "calibration"

    @classmethod
    def create(cls, experiment: str, out: Path | None) -> RunFolder:
        """Make the folder: ``out``, or a new one under ``runs/``.

        Raises InputError when ``out`` holds something already or cannot be written: nothing recorded is overwritten.
        """
        path = out or Path("runs") / f"{experiment}-{datetime.now(UTC):%Y%m%dT%H%M%S.%f}"
        try:
            if path.exists() and (not path.is_dir() or any(path.iterdir())):
                raise InputError(
                    [Problem(str(path), None, "--out", "there is something there already", "a new or an empty folder")]
                )
            path.mkdir(parents=True, exist_ok=True)
            probe = path / ".probe"
            probe.write_text("")
            probe.unlink()
        except OSError as error:
            raise InputError(
                [Problem(str(path), None, "--out", f"cannot be written: {error.strerror}", "a folder you may write to")]
            ) from None
        return cls(path)

    def written_logs(self) -> list[Path]:
        """The logs as runs wrote them, in their order: ``log.mcap``, and ``log.1.mcap`` … of a run that went on.

        One of which only the mended form is left is among them.
        """
        return written_logs(self.path)

    def logs(self) -> list[Path]:
        """The logs to read, in their order: each in its mended form, where there is one."""
        return [to_read(log) for log in self.written_logs()]

    @classmethod
    def open(cls, path: Path) -> RunFolder:
        """An existing run folder. Raises InputError when there is none."""
        if not (path / "experiment.yaml").is_file():
            why = "no experiment.yaml in it" if path.exists() else "it is not there"
            wrong = f"{why}, so no run folder"
            newest = max(Path("runs").glob("*/experiment.yaml"), key=lambda file: file.stat().st_mtime, default=None)
            near = "" if newest is None else str(newest.parent)
            expected = "a folder under runs/; `extrinsic run EXPERIMENT` makes one"
            raise InputError([Problem(str(path), None, "RUN", wrong, expected, near)])
        return cls(path)

    def next_log(self) -> Path:
        """Where the next log goes: log.mcap, then log.1.mcap, log.2.mcap, …; none that lies here is touched."""
        path, number, written = self.log, 0, self.written_logs()
        while path in written or path.exists():
            number += 1
            path = self.log.with_name(f"{self.log.stem}.{number}{self.log.suffix}")
        return path


def write_atomic(path: Path, text: str) -> None:
    """Write aside, fsync, rename: a reader sees the old file or the new one, never a half."""
    aside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with aside.open("w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        aside.replace(path)
    except BaseException:  # a full disk, most likely, and it is not to be filled by this
        aside.unlink(missing_ok=True)
        raise


def write_json(path: Path, data: Any) -> None:
    """Write ``data`` atomically as JSON that every parser reads: a figure that is not finite is an error here."""
    write_atomic(path, json.dumps(data, indent=2, allow_nan=False, ensure_ascii=False) + "\n")
