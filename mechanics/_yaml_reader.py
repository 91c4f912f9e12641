"""From YAML text to plain data and the line of every key: no tags, no code, bounded in size and depth.

Built on the event stream, which is not recursive: text that is nested a hundred thousand deep is refused, not a crash.
Scalars follow YAML 1.2's core schema (so 1e-3 is a number and ``on`` is text); figures must be finite.
"""

from __future__ import annotations

import io
import math
import re
from dataclasses import dataclass, field
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.events import (
    AliasEvent,
    DocumentStartEvent,
    MappingEndEvent,
    MappingStartEvent,
    ScalarEvent,
    SequenceEndEvent,
    SequenceStartEvent,
)

Path = tuple[str | int, ...]

MAX_DEPTH = 32  # a resolved run file is 8 deep
MAX_NODES = 10_000  # counted after aliases are written out: a polygon of 3000 vertices fits, read in half a second

_INT = re.compile(r"[-+]?[0-9]+")
_BASED = re.compile(r"0o[0-7]+|0x[0-9a-fA-F]+")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_NOT_FINITE = re.compile(r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)")
_WORDS = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL")),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
}


class YamlFault(Exception):
    """Text that is not read; ``line`` counts from 1 and is None where there is none."""

    def __init__(self, line: int | None, wrong: str, expected: str):
        super().__init__(wrong)
        self.line, self.wrong, self.expected = line, wrong, expected


@dataclass
class _Open:
    """A collection whose end has not been seen: its pending ``key``, ``size`` in nodes and ``height`` in levels."""

    value: dict[str, Any] | list[Any]
    path: Path
    anchor: str | None
    key: str | None = None
    size: int = 1
    height: int = 1
    lines: dict[str, int] = field(default_factory=dict)


def read(text: str) -> tuple[Any, dict[Path, int]]:
    """The data in ``text`` and the line (from 1) of each key and item by its path; the root's path is ``()``.

    Raises YamlFault. Empty text is None.
    """
    builder = _Builder()
    try:
        for event in YAML(typ="safe", pure=True).parse(io.StringIO(text)):
            builder.take(event)
    except YamlFault:
        raise
    except MarkedYAMLError as e:
        mark = e.problem_mark or e.context_mark
        what = ", ".join(str(part) for part in (e.context, e.problem) if part)
        raise YamlFault(None if mark is None else mark.line + 1, f"not YAML: {what}", "`key: value` lines") from None
    except YAMLError as e:
        first = (str(e).splitlines() or [type(e).__name__])[0]
        raise YamlFault(None, f"not YAML: {first}", "plain text in UTF-8") from None
    except Exception as e:  # arbitrary bytes reach a parser that is not ours: whatever it trips over is no YAML
        raise YamlFault(None, f"not YAML ({type(e).__name__})", "`key: value` lines") from None
    return builder.root, builder.lines


class _Builder:
    def __init__(self) -> None:
        self.root: Any = None
        self.lines: dict[Path, int] = {}
        self._open: list[_Open] = []
        self._anchors: dict[str, tuple[Any, int, int]] = {}
        self._nodes = 0
        self._documents = 0

    def take(self, event: Any) -> None:
        line = event.start_mark.line + 1
        if getattr(event, "tag", None) is not None:
            raise YamlFault(line, f"the tag {event.tag!r} is not read", "plain values without tags")
        if isinstance(event, DocumentStartEvent):
            self._documents += 1
            if self._documents > 1:
                raise YamlFault(line, "a second document starts here", "one document in a file")
        elif isinstance(event, (MappingStartEvent, SequenceStartEvent)):
            self._start({} if isinstance(event, MappingStartEvent) else [], event.anchor, line)
        elif isinstance(event, (MappingEndEvent, SequenceEndEvent)):
            closed = self._open.pop()
            if closed.anchor is not None:
                self._anchors[closed.anchor] = (closed.value, closed.size, closed.height)
            if self._open:
                parent = self._open[-1]
                parent.size += closed.size
                parent.height = max(parent.height, closed.height + 1)
        elif isinstance(event, ScalarEvent):
            self._scalar(event, line)
        elif isinstance(event, AliasEvent):
            self._alias(event.anchor, line)

    def _start(self, value: dict[str, Any] | list[Any], anchor: str | None, line: int) -> None:
        if len(self._open) >= MAX_DEPTH:
            raise YamlFault(line, f"nested more than {MAX_DEPTH} deep", "a flatter file")
        path = self._place(value, line, 1)
        self._open.append(_Open(value, path, anchor))

    def _scalar(self, event: Any, line: int) -> None:
        value = _resolved(event.value, line) if event.implicit[0] and event.style is None else event.value
        if isinstance(value, str) and any("\ud800" <= c <= "\udfff" for c in value):
            raise YamlFault(line, "text with half a character (a lone surrogate)", "plain text")
        if event.anchor is not None:
            self._anchors[event.anchor] = (value, 1, 0)
        parent = self._open[-1] if self._open else None
        if parent is not None and isinstance(parent.value, dict) and parent.key is None:
            self._key(parent, value, event.value, line)
            return
        if parent is not None:
            parent.size += 1
        self._place(value, line, 1)

    def _key(self, parent: _Open, value: Any, written: str, line: int) -> None:
        if not isinstance(value, str):
            raise YamlFault(line, f"the key {written!r} is no text", 'a name, or the key in quotes ("...")')
        if value == "<<":
            raise YamlFault(line, "merge keys (<<) are not read", "the keys written out")
        if value in parent.lines:
            raise YamlFault(
                line, f"the key {value!r} stands twice, first on line {parent.lines[value]}", "each key once"
            )
        parent.key = value
        parent.lines[value] = line

    def _alias(self, anchor: str, line: int) -> None:
        if anchor not in self._anchors:
            raise YamlFault(line, f"*{anchor} refers to nothing that is complete", f"an earlier &{anchor}")
        value, size, height = self._anchors[anchor]
        if len(self._open) + height > MAX_DEPTH:
            raise YamlFault(line, f"nested more than {MAX_DEPTH} deep", "a flatter file")
        parent = self._open[-1]  # the parser refuses an alias before any node
        if isinstance(parent.value, dict) and parent.key is None:
            self._key(parent, value, f"*{anchor}", line)
            return
        parent.size += size
        parent.height = max(parent.height, height + 1)
        # A path through an alias has the alias's own line, by way of its nearest ancestor.
        self._count(size, line)
        self._place(copied(value), line, 0)

    def _count(self, nodes: int, line: int) -> None:
        self._nodes += nodes
        if self._nodes > MAX_NODES:
            raise YamlFault(line, f"more than {MAX_NODES} values", "a smaller file")

    def _place(self, value: Any, line: int, nodes: int) -> Path:
        """Put ``value`` where the innermost open collection waits for one; its path."""
        self._count(nodes, line)
        if not self._open:
            self.root, path = value, ()
        else:
            parent = self._open[-1]
            if isinstance(parent.value, dict):
                if parent.key is None:
                    raise YamlFault(line, "a key is a list or a mapping", 'a name, or the key in quotes ("...")')
                path = (*parent.path, parent.key)
                line = parent.lines[parent.key]
                parent.value[parent.key], parent.key = value, None
            else:
                path = (*parent.path, len(parent.value))
                parent.value.append(value)
        self.lines[path] = line
        return path


def copied(value: Any) -> Any:
    """``value`` with collections of its own."""
    if isinstance(value, dict):
        return {key: copied(item) for key, item in value.items()}
    return [copied(item) for item in value] if isinstance(value, list) else value


def _resolved(text: str, line: int) -> Any:
    """A plain scalar by YAML 1.2's core schema."""
    if text in _WORDS:
        return _WORDS[text]
    if _INT.fullmatch(text) or _BASED.fullmatch(text):
        if len(text) > 300:
            raise YamlFault(line, f"a number of {len(text)} digits", "a figure that a double can hold")
        return int(text) if _INT.fullmatch(text) else int(text, 0)
    if _FLOAT.fullmatch(text):
        value = float(text)
        if math.isfinite(value):
            return value
    elif not _NOT_FINITE.fullmatch(text):
        return text
    raise YamlFault(line, f"{text} is not finite", "a finite number")
