"""Plans as files: one npz archive each, its arrays as they are and the rest as JSON, readable without the package."""

from __future__ import annotations

import json
import lzma
import math
import os
import re
import struct
import tempfile
import zipfile
import zlib
from pathlib import Path

import numpy as np

from planning.plan import SCHEMA, Plan

SUFFIX = ".npz"
_REST = "plan"
#: bytes that a plan may have: 50 000 steps with ten contacts
_ROOM = 2**25
_HEADER = re.compile(
    rb"\x93NUMPY(?:\x01\x00..|\x02\x00....)"
    rb"\{'descr': '(<f8|<U[1-9]\d{0,7})', 'fortran_order': (True|False), 'shape': \(([\d, ]{0,60})\), \} *\n",
    re.DOTALL,
)
_NO_ARCHIVE = (
    OSError,
    ValueError,
    KeyError,
    EOFError,
    NotImplementedError,  # zipfile raises it for a compression that it does not know
    RuntimeError,
    struct.error,
    zlib.error,
    lzma.LZMAError,
    zipfile.BadZipFile,
)


class PlanFileError(Exception):
    """A file that is no plan which this version can execute. Fields: ``path``, ``problem``, ``remedy``."""

    def __init__(self, path: str, problem: str, remedy: str = "plan again"):
        self.path, self.problem, self.remedy = path, problem, remedy
        super().__init__(path, problem, remedy)

    def __str__(self) -> str:
        return f"{self.path}: {self.problem}: {self.remedy}"


def save(plan: Plan, path: str | os.PathLike[str]) -> Path:
    """Write ``plan`` to ``path``, whole or not at all; return the path. Raises ValueError unless it ends in .npz."""
    path = Path(path)
    if path.suffix != SUFFIX:
        raise ValueError(f"plan file: expected a name that ends in {SUFFIX}, received '{path.name}'")
    plain = plan.to_dict()
    arrays = {name: getattr(plan, name) for name in plain if isinstance(getattr(plan, name, None), np.ndarray)}
    rest = {name: value for name, value in plain.items() if name not in arrays}
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}.", suffix=".part", delete=False) as file:
        try:
            np.savez(file, allow_pickle=False, **arrays, **{_REST: np.array(json.dumps(rest, allow_nan=False))})
            file.flush()
            os.fsync(file.fileno())
        except BaseException:
            Path(file.name).unlink()
            raise
    written = Path(file.name)
    written.chmod(0o666 & ~_umask())
    return written.replace(path)


def load(path: str | os.PathLike[str]) -> Plan:
    """Read the plan in ``path``, the same to the last bit.

    Raises PlanFileError for a file that is not there, damaged, no plan, larger than any, or of another schema.
    """
    name = os.fspath(path)
    try:
        with zipfile.ZipFile(path) as archive:
            arrays = _arrays(archive)
        rest = json.loads(str(arrays.pop(_REST)))
    except FileNotFoundError:
        raise PlanFileError(name, "there is no such file", "give the path of a plan") from None
    except _NO_ARCHIVE as error:
        raise PlanFileError(name, f"damaged, or no plan ({error})") from None
    schema = rest.get("schema") if isinstance(rest, dict) else None
    if schema != SCHEMA:
        raise PlanFileError(name, f"schema {schema!r:.60}, this version reads {SCHEMA}", "plan again with this version")
    try:
        return Plan.from_dict({**rest, **arrays})
    except ValueError as error:
        raise PlanFileError(name, f"damaged, or no plan ({error})") from None


def _arrays(archive: zipfile.ZipFile) -> dict[str, np.ndarray]:
    """The arrays as `save` has numpy write them: float64, and one of text. numpy's own reader makes the room that a
    header asks for before it looks at what there is. Raises one of `_NO_ARCHIVE`.
    """
    if sum(info.file_size for info in archive.infolist()) > _ROOM:
        raise ValueError(f"more than {_ROOM} bytes unpacked")
    found: dict[str, np.ndarray] = {}
    for info in archive.infolist():
        with archive.open(info) as file:
            content = file.read(_ROOM)
        header = _HEADER.match(content)
        if header is None:
            raise ValueError(f"{info.filename!r:.60} is no array of numbers or text")
        kind, order, sizes = header[1].decode(), "F" if header[2] == b"True" else "C", header[3].split(b",")
        shape = tuple(int(size) for size in sizes if size.strip())
        array = np.frombuffer(content, np.dtype(kind), offset=header.end())
        if array.size != math.prod(shape):
            raise ValueError(f"{info.filename!r:.60} has {array.size} values, {shape} do not fit")
        found[info.filename.removesuffix(".npy")] = array.reshape(shape, order=order)
    return found


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
