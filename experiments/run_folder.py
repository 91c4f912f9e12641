"""The run folder: what a run leaves behind, written so that a half file never lies there."""

from __future__ import annotations

import json
import os
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

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

    @classmethod
    def open(cls, path: Path) -> RunFolder:
        """An existing run folder. Raises InputError when there is none."""
        if not (path / "experiment.yaml").is_file():
            raise InputError(
                [Problem(str(path), None, "RUN", "no experiment.yaml in it, so no run folder", "a folder under runs/")]
            )
        return cls(path)


def write_atomic(path: Path, text: str) -> None:
    """Write aside, fsync, rename: a reader sees the old file or the new one, never a half."""
    aside = path.with_name(f".{path.name}.{os.getpid()}")
    with aside.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    aside.replace(path)


def write_json(path: Path, data: Any) -> None:
    """Write ``data`` atomically as JSON that every parser reads: a figure that is not finite is an error here."""
    write_atomic(path, json.dumps(data, indent=2, allow_nan=False, ensure_ascii=False) + "\n")
