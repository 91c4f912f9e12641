"""Where a run's numbers come from: the code's revision, the versions of what matters, the machine."""

from __future__ import annotations

import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from experiments import __version__
from mechanics import announced

PACKAGES = ("numpy", "torch", "cvxpy", "cvxpylayers", "mujoco", "eclipse-zenoh", "mcap", "pupil-apriltags")


def provenance() -> dict:
    """Revision (None outside a checkout) with a ``-dirty`` mark, package versions, and the host, JSON-able.

    Packages whose drivers, skills, optimisers or controllers were asked for in this process are among the versions.
    """
    return {"git": revision(), "versions": _versions(), "host": _host()}


def revision() -> str | None:
    """What git calls this checkout; None outside one."""
    root = Path(__file__).resolve().parent.parent
    if not (root / ".git").exists():
        return None
    try:
        described = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=12"],
            cwd=root,
            capture_output=True,
            text=True,
            timeout=5,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return described.stdout.strip()


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version(), "extrinsic": __version__}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found | announced.loaded()


def _host() -> dict[str, str]:
    return {"system": platform.platform(), "machine": platform.machine()}
