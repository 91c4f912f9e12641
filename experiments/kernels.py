"""The compiled kernels of the planner: where they are kept, and having them ready before somebody waits for them.

``python -m experiments.kernels`` compiles what is not compiled yet, as an installation does; it takes about half a
minute once. numba keeps the result beside the sources, or in the user's cache folder where those may not be written.
"""

from __future__ import annotations

import os
import stat
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mechanics.readings import Array
    from planning.optimisers.base import Quadratic

VARIABLE = "NUMBA_CACHE_DIR"


def keep() -> None:
    """See to it that numba finds a folder to keep kernels in; call it before anything imports numba.

    Where neither the sources' folder nor the user's cache folder may be written, numba would refuse to work at all: it
    gets a folder among the temporary files then, this user's own.
    """
    if VARIABLE in os.environ or any(_may_write(folder) for folder in (Path(__file__).parent, _user_cache())):
        return
    os.environ[VARIABLE] = str(_temporary())


def warm() -> None:
    """Compile the planner's kernels, or load them from the cache."""
    import numpy as np

    from planning import fused
    from planning.optimisers.lm import LevenbergMarquardt

    fused.warm()
    bowl = _Bowl()
    LevenbergMarquardt(iterations=3).optimise(bowl, bowl.start, np.random.default_rng(0))


class _Bowl:
    """The loss Σ z², on which an optimiser compiles what it has of its own."""

    def __init__(self) -> None:
        import numpy as np

        self.start, self.free = np.ones((3, 5)), np.ones((3, 5), bool)

    def values(self, z: Array) -> Array:
        return (z**2).sum((1, 2))

    def gradient(self, z: Array) -> tuple[float, Array]:
        return float((z**2).sum()), 2 * z

    def quadratic(self, z: Array) -> Quadratic:
        import numpy as np

        from planning.optimisers.base import Quadratic

        diagonal = np.tile(2 * np.eye(5), (3, 1, 1))
        return Quadratic(float((z**2).sum()), 2 * z, diagonal, np.zeros((2, 5, 5)))


def _user_cache() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())


def _may_write(folder: Path) -> bool:
    """Whether ``folder`` can be written, or made."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return folder.is_dir() and os.access(folder, os.W_OK | os.X_OK)


def _temporary() -> Path:
    """The same folder at each start, unless somebody else owns it: what is kept there is loaded as code."""
    owner = os.getuid() if hasattr(os, "getuid") else 0
    folder = Path(tempfile.gettempdir()) / f"extrinsic-kernels-{owner}"
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    own = not hasattr(os, "getuid") or (found.st_uid == owner and not found.st_mode & 0o022)
    if stat.S_ISDIR(found.st_mode) and own:
        return folder
    return Path(tempfile.mkdtemp(prefix="extrinsic-kernels-"))


def main() -> None:
    """Compile everything and say how long it took."""
    keep()
    begin = time.perf_counter()
    from drivers import tag_edges
    from drivers.sim import area_coverage

    warm()
    tag_edges.warm()
    area_coverage.warm()
    sys.stdout.write(f"the kernels of planner and tag camera are ready after {time.perf_counter() - begin:.1f} s\n")


if __name__ == "__main__":
    main()
