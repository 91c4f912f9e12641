"""Plans as files: one npz archive each, its arrays as they are and the rest as JSON, readable without the package."""

from __future__ import annotations

import json
import os
import tempfile
import zipfile
from pathlib import Path

import numpy as np

from planning.plan import SCHEMA, Plan

SUFFIX = ".npz"
_REST = "plan"


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

    Raises PlanFileError for a file that is not there, damaged, no plan, or of another schema.
    """
    name = os.fspath(path)
    try:
        # np.load leaves a damaged archive open that it has opened itself
        with Path(path).open("rb") as file, np.load(file, allow_pickle=False) as archive:
            arrays = {key: archive[key] for key in archive.files if key != _REST}
            rest = json.loads(str(archive[_REST]))
    except FileNotFoundError:
        raise PlanFileError(name, "there is no such file", "give the path of a plan") from None
    except (OSError, ValueError, KeyError, EOFError, AttributeError, TypeError, zipfile.BadZipFile) as error:
        raise PlanFileError(name, f"damaged, or no plan ({error})") from None
    schema = rest.get("schema") if isinstance(rest, dict) else None
    if schema != SCHEMA:
        raise PlanFileError(name, f"schema {schema!r}, this version reads {SCHEMA}", "plan again with this version")
    try:
        return Plan.from_dict({**rest, **arrays})
    except (ValueError, TypeError) as error:
        raise PlanFileError(name, f"damaged, or no plan ({error})") from None


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
