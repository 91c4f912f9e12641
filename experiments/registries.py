"""What experiment files can name: every skill under `planning.skills`, optimiser under `planning.optimisers` and
controller under `control`.

One file each: putting a file there that registers its class is all it takes. They are imported on first use, so that
`--help` stays fast.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Mapping
from functools import cache
from typing import Any


@cache
def skills() -> Mapping[str, Any]:
    """Skill classes by name."""
    _import_all("planning.skills")
    return importlib.import_module("planning.skills.base").SKILLS


@cache
def optimisers() -> Mapping[str, Any]:
    """Optimiser classes by name."""
    _import_all("planning.optimisers")
    return importlib.import_module("planning.optimisers.base").OPTIMISERS


@cache
def controllers() -> Mapping[str, Any]:
    """Controller classes by name."""
    _import_all("control")
    return importlib.import_module("control.base").CONTROLLERS


def _import_all(package: str) -> None:
    for module in pkgutil.iter_modules(importlib.import_module(package).__path__, f"{package}."):
        importlib.import_module(module.name)
