"""What installed packages announce to this project by entry points: drivers, skills, optimisers, controllers.

Nothing of a package is imported before one of its names is asked for, so that one which is broken harms nobody who does
not use it; where one is asked for, its package is named in whatever is wrong.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from mechanics.yaml_input import KeyPath, Refusal

#: versions of the packages of which something was loaded in this process, by the package's name
_LOADED: dict[str, str] = {}


def names(group: str) -> tuple[str, ...]:
    """What packages announce in a group of entry points, sorted, each once."""
    return tuple(sorted(_entries(group)))


def load(group: str, kind: str, name: str, expected: Callable[[Any], str | None], at: KeyPath = ()) -> Any:
    """What the entry point ``name`` of a group stands for; ``kind`` says in a word what that is.

    ``expected`` answers None, or what the thing found should have been. Raises Refusal, at ``at``, where the package
    cannot be imported, where two packages announce the name, and where the thing is none of its kind.
    """
    first, *others = _entries(group)[name]
    if others:
        whose = " and ".join(sorted(_whose(entry) for entry in (first, *others)))
        raise Refusal(f"{kind} {name!r} is announced by {whose}", "one of them, the other uninstalled", at=at)
    wrong = f"{kind} {name!r} of {_whose(first)}"
    try:
        found = first.load()
    except (Exception, SystemExit) as error:  # somebody else's code: whatever it raises, one is to know whose it is
        wrong = f"{wrong} cannot be imported: {type(error).__name__}: {error}"
        raise Refusal(wrong, "a package that is installed as it should be", at=at) from error
    if (should := expected(found)) is not None:
        raise Refusal(f"{wrong} is {_described(found)}", should, at=at)
    if first.dist is not None:
        _LOADED[first.dist.name] = first.dist.version
    return found


def loaded() -> dict[str, str]:
    """The versions of the packages of which something was loaded in this process, by the package's name."""
    return dict(sorted(_LOADED.items()))


@cache
def _entries(group: str) -> dict[str, tuple[EntryPoint, ...]]:
    found: dict[str, tuple[EntryPoint, ...]] = {}
    for entry in entry_points(group=group):
        found[entry.name] = (*found.get(entry.name, ()), entry)
    return found


def _whose(entry: EntryPoint) -> str:
    package = "" if entry.dist is None else f"{entry.dist.name} {entry.dist.version} "
    return f"{package}({entry.value})"


def _described(found: Any) -> str:
    return f"the class {found.__qualname__}" if isinstance(found, type) else f"a {type(found).__name__}"
