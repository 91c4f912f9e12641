"""Rerun is an extra: whether it is installed, and where its viewer is."""

from __future__ import annotations

import os
import sys
from importlib.util import find_spec
from pathlib import Path

from mechanics.yaml_input import InputError, Problem

INSTALL = "pip install 'extrinsic[view]'"
APPLICATION = "extrinsic"


def need() -> None:
    """Raise InputError where Rerun is not installed."""
    if find_spec("rerun") is None:
        wrong = "it shows runs in Rerun, and the package rerun-sdk is not installed"
        raise InputError([Problem("view", None, "", wrong, INSTALL)])


def viewer() -> Path:
    """The viewer's program. Raises InputError where the package has none."""
    spec = find_spec("rerun_cli")
    if spec is not None and spec.origin is not None:
        folder = Path(spec.origin).parent
        names = {"darwin": ("Rerun.app/Contents/MacOS/Rerun", "rerun"), "win32": ("rerun.exe",)}
        for name in names.get(sys.platform, ("rerun",)):
            if os.access(folder / name, os.X_OK):
                return folder / name
    wrong = "the package rerun-sdk that is installed has no viewer for this machine"
    raise InputError([Problem("view", None, "", wrong, "--save FILE, and look at the file elsewhere")])
