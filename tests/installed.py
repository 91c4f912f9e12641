"""Packages as an installer leaves them: a module, and beside it what says whose it is and what it announces."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from mechanics import announced

Install = Callable[..., None]


@contextmanager
def installer(folder: Path) -> Iterator[Install]:
    """``install(package, group, source, name="module:thing")`` into ``folder``, which is on the path meanwhile."""

    def install(package: str, group: str, source: str = "", **entries: str) -> None:
        module = package.replace("-", "_")
        (folder / f"{module}.py").write_text(source)
        info = folder / f"{module}-1.2.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.2\n")
        lines = [f"{name} = {value}" for name, value in entries.items()]
        (info / "entry_points.txt").write_text("\n".join([f"[{group}]", *lines]) + "\n")
        announced._entries.cache_clear()

    before = set(sys.modules)
    sys.path.insert(0, str(folder))
    try:
        yield install
    finally:
        sys.path.remove(str(folder))
        announced._entries.cache_clear()
        for module in set(sys.modules) - before:
            if str(getattr(sys.modules[module], "__file__", "")).startswith(str(folder)):
                del sys.modules[module]
