"""What experiment files can name: skills, optimisers and controllers, ours and those of installed packages.

Ours are under `planning.skills`, `planning.optimisers` and `control`, one file each: putting a file there that
registers its class is all it takes. A package of somebody else announces a class by an entry point of the group
``extrinsic.skills``, ``extrinsic.optimisers`` or ``extrinsic.controllers``, whose name is the class's own::

    [project.entry-points."extrinsic.controllers"]
    my_law = "my_package:MyLaw"

One of ours by the same name comes first. All are imported on first use, so that `--help` stays fast, and those of a
package only when one of them is named.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from functools import cache
from typing import Any

from pydantic import ValidationError

from mechanics import announced
from mechanics.yaml_input import KeyPath, Refusal, nearest, one_of


class Known(Mapping[str, Any]):
    """Classes of one ``kind`` by name: ``ours``, and what packages announce in the group ``extrinsic.<kind>s``.

    Its keys are what can be named; a class is imported when its name is looked up. ``expected`` answers what a
    package's class should have been, None where it is one of this kind.
    """

    def __init__(self, kind: str, ours: Mapping[str, Any], expected: Callable[[Any], str | None]):
        self._kind, self._ours, self._expected = kind, ours, expected
        self._group = f"extrinsic.{kind}s"
        self._loaded: dict[str, Any] = {}

    def __iter__(self) -> Iterator[str]:
        yield from self._ours
        yield from (name for name in announced.names(self._group) if name not in self._ours)

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def __contains__(self, name: object) -> bool:
        return name in self._ours or name in announced.names(self._group)

    def __getitem__(self, name: str) -> Any:
        """Raises KeyError for an unknown name, and Refusal where its package is not as it should be."""
        if name not in self:
            raise KeyError(name)
        return self.named(name)

    def named(self, name: str, at: KeyPath = ()) -> Any:
        """The class of a name that stands at ``at``, for validators. Raises Refusal."""
        if name in self._ours:
            return self._ours[name]
        if name not in self:
            raise Refusal(f"unknown {self._kind} {name!r}", one_of(self), nearest(name, self), at=at)
        if name not in self._loaded:
            self._loaded[name] = announced.load(
                self._group, self._kind, name, lambda found: self._not_as_announced(found, name), at
            )
        return self._loaded[name]

    def usable(self, names: Iterable[object] | None = None) -> dict[str, Any]:
        """The classes of these names, of all by default, without those that are unknown or cannot be used.

        For those who tell of them (schemas, errors of other keys): what is wrong with one is said where it is named.
        """
        found = {}
        for name in self if names is None else names:
            with suppress(KeyError, Refusal):
                if isinstance(name, str):
                    found[name] = self[name]
        return found

    def _not_as_announced(self, found: Any, name: str) -> str | None:
        if (should := self._expected(found)) is not None:
            return should
        own = getattr(found, "name", None)
        return None if own == name else f"a class whose `name` is that of its entry point, not {own!r}"


@cache
def skills() -> Known:
    """Skill classes by name."""
    _import_all("planning.skills")
    from planning.skills.base import SKILLS, Skill, SkillParameters

    def expected(found: Any) -> str | None:
        if not _is_a(found, Skill):
            return "a class under planning.skills.base.Skill, with all of its methods"
        if not _is_a(getattr(found, "Parameters", None), SkillParameters):
            return "a skill whose `Parameters` are a planning.skills.base.SkillParameters"
        return None

    return Known("skill", SKILLS, expected)


@cache
def optimisers() -> Known:
    """Optimiser classes by name."""
    _import_all("planning.optimisers")
    from planning.optimisers.base import OPTIMISERS, Optimiser

    def expected(found: Any) -> str | None:
        if not _is_a(found, Optimiser):
            return "a dataclass under planning.optimisers.base.Optimiser, with all of its methods"
        return None

    return Known("optimiser", OPTIMISERS, expected)


@cache
def controllers() -> Known:
    """Controller classes by name."""
    _import_all("control")
    from control.base import CONTROLLERS, Controller, LawSettings

    def expected(found: Any) -> str | None:
        if not _is_a(found, Controller):
            return "a class under control.base.Controller, with all of its methods"
        if not _is_a(found.Settings, LawSettings):
            return "a controller whose `Settings` are a control.base.LawSettings"
        try:
            found.Settings()
        except ValidationError:
            return "a controller whose `Settings` have a default each"
        return None

    return Known("controller", CONTROLLERS, expected)


def _is_a(found: Any, base: type) -> bool:
    return isinstance(found, type) and issubclass(found, base) and not inspect.isabstract(found)


def _import_all(package: str) -> None:
    for module in pkgutil.iter_modules(importlib.import_module(package).__path__, f"{package}."):
        importlib.import_module(module.name)
