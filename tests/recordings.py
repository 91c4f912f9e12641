"""Recordings of real devices, for tests that compare with them.

They are others' and no part of the project, so whoever has none must still be able to run the tests: what wants a
recording is skipped where it is absent. They are looked for in ``$EXTRINSIC_DATA``, else in ``shared/data`` beside the
checkout. This is the one place that skips for them.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest

DATA = Path(os.environ.get("EXTRINSIC_DATA", Path(__file__).parents[2] / "shared" / "data"))


def recorded(name: str) -> pytest.MarkDecorator:
    """Skip a test where the recording ``name``, a file or folder of `DATA`, is absent."""
    return pytest.mark.skipif(not (DATA / name).exists(), reason=_absent(name))


def recording(name: str) -> Path:
    """The path of a recording, for fixtures, which no mark can skip."""
    if not (DATA / name).exists():
        pytest.skip(_absent(name))
    return DATA / name


def _absent(name: str) -> str:
    return f"no recording '{name}' in {DATA}: set EXTRINSIC_DATA to the folder that has it"
