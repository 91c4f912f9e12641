"""How the kernels are compiled, and what the compiled ones on disk are filed under.

Numba compiles a function anew where its own file is newer than its cache, and does not look at the files of what it
calls. A closure's variables are part of the key, so the entry points close over the `fingerprint` of all kernels: after
any change they are compiled anew. What they call is not cached on its own: it is part of them.
"""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

from numba import njit

_UNCOUNTED: dict[str, Any] = {"_nrt": False}
kernel = njit(fastmath={"contract"}, error_model="numpy", **_UNCOUNTED)
"""For what entry points call. A division by zero is no error but inf or NaN, which the callers look for; a product and
a sum may be rounded as one.

``_nrt`` off: these allocate nothing, and without it every array handed on is counted, atomically, on the way in and
out, which took two thirds of the time. Numba has the option for its own kernels."""

inlined = njit(fastmath={"contract"}, error_model="numpy", forceinline=True, **_UNCOUNTED)
"""For the kernels of a step, which are compiled into their place: there the shapes of the arrays are constants, which
halves the time. Each of their calls is a copy, so what is large is called from one place."""

entry = njit(cache=True, fastmath=False, error_model="numpy")
"""For what Python calls, a closure over the fingerprint."""


def fingerprint() -> int:
    """Return a checksum of the kernels' sources."""
    here = Path(__file__).parent
    return zlib.crc32(b"\0".join(path.read_bytes() for path in sorted(here.glob("*.py"))))
