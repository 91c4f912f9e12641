"""The measurements behind a calibration, kept in the run folder: whoever doubts a figure can fit it again."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from experiments.context import RunContext
from mechanics.readings import Array


def save_samples(context: RunContext, name: str, columns: Mapping[str, Array]) -> None:
    """Write ``columns``, all of one length, as ``calibration/<name>.csv`` of the run."""
    path = context.folder.calibration / f"{name}.csv"
    path.parent.mkdir(exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*(np.asarray(values).tolist() for values in columns.values()), strict=True))


def load_samples(path: Path) -> dict[str, Array]:
    """Columns by name, as `save_samples` wrote them."""
    with path.open(newline="", encoding="utf-8") as file:
        header, *rows = csv.reader(file)
    values = np.array(rows, float).reshape(len(rows), len(header))
    return {name: values[:, i] for i, name in enumerate(header)}
