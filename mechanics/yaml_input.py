"""The one place where files from a person are read: YAML into models, with errors that a person can act on.

Every problem says where it is (file and line, or the ``--set`` it came from), which key, what is wrong, what was
expected and, where a name was misspelt, the nearest valid one.
"""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin

from pydantic import BaseModel, ValidationError

from mechanics import _yaml_reader, model_paths

MAX_BYTES = 256 * 1024
MOST = 50
"""Faults of one file that are told at once: nobody reads more, and thousands take seconds to put into words."""

M = TypeVar("M", bound=BaseModel)
KeyPath = tuple[str | int, ...]


@dataclass(frozen=True)
class Problem:
    """One thing wrong: ``file`` (or the command-line option), ``line`` from 1, dotted ``key``, and what helps."""

    file: str
    line: int | None
    key: str
    wrong: str
    expected: str = ""
    nearest: str = ""

    def __str__(self) -> str:
        place = self.file if self.line is None else f"{self.file}, line {self.line}"
        shown = f"{self.key}: " if self.key and not place.endswith(f" {self.key}") else ""
        lines = [f"{place}: {shown}{self.wrong}"]
        lines += [f"    expected: {self.expected}"] if self.expected else []
        lines += [f"    nearest:  {self.nearest}"] if self.nearest else []
        return "\n".join(lines)


class InputError(Exception):
    """Input from a person that cannot be used; nothing has been started. ``problems`` holds each fault."""

    def __init__(self, problems: Iterable[Problem]):
        self.problems = tuple(problems)
        super().__init__(self.problems)

    def __str__(self) -> str:
        return "\n".join(str(problem) for problem in self.problems)


class Refusal(ValueError):
    """Raised in a model's validator: what is wrong with the value at ``at`` (relative to the validated value)."""

    def __init__(self, wrong: str, expected: str = "", nearest: str = "", at: KeyPath = ()):
        super().__init__(wrong)
        self.wrong, self.expected, self.nearest, self.at = wrong, expected, nearest, at
        self.inner: tuple[type[BaseModel], Any, ValidationError] | None = None


@dataclass(frozen=True)
class Document:
    """Data from a file, and where each part of it was written: a line, or the option that set it.

    ``prefix`` is the path of this part within the file it came from.
    """

    data: dict[str, Any]
    positions: Mapping[KeyPath, int | str] = field(repr=False)
    file: str
    prefix: KeyPath = ()

    def problem(self, path: KeyPath, wrong: str, expected: str = "", nearest: str = "") -> Problem:
        """A problem with what stands at ``path``."""
        place: int | str | None = None
        for n in range(len(path), -1, -1):
            if (place := self.positions.get(path[:n])) is not None:
                break
        if isinstance(place, str):
            return Problem(place, None, dotted(path), wrong, expected, nearest)
        return Problem(self.file, place, dotted((*self.prefix, *path)), wrong, expected, nearest)

    def part(self, key: str) -> Document:
        """The mapping under ``key`` as a document of its own. Raises InputError where there is none."""
        data = self.data.get(key)
        if not isinstance(data, dict):
            raise InputError([self.problem((key,), _described(data), "a mapping (`key: value` lines)")])
        positions = {path[1:]: place for path, place in self.positions.items() if path[:1] == (key,)}
        return Document(data, positions, self.file, (*self.prefix, key))


def dotted(path: Sequence[str | int]) -> str:
    """A path as it is written on the command line: ``stages.0.parameters``."""
    return ".".join(str(key) for key in path)


def nearest(word: str, options: Iterable[str]) -> str:
    """The option that ``word`` probably meant, or ''."""
    known = {str(option).lower(): str(option) for option in options}
    found = difflib.get_close_matches(word.lower(), list(known), 1, 0.5)
    return known[found[0]] if found else ""


def one_of(options: Iterable[str]) -> str:
    """The options in words."""
    names = sorted({str(option) for option in options})
    return names[0] if len(names) == 1 else "one of " + ", ".join(names)


def read_yaml(path: str | os.PathLike[str], root: Path | None = None) -> Document:
    """The mapping in a YAML file. Raises InputError for anything else. ``root``: shown paths are relative to it."""
    file = Path(path)
    shown = str(file)
    if root is not None and file.is_absolute() and file.is_relative_to(root):
        shown = str(file.relative_to(root))
    try:
        if file.is_dir():
            raise InputError([Problem(shown, None, "", "this is a folder", "a YAML file")])
        if file.exists() and not file.is_file():
            raise InputError([Problem(shown, None, "", "this is no ordinary file", "a YAML file")])
        with file.open("rb") as stream:
            content = stream.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise InputError([Problem(shown, None, "", "there is no such file", "a YAML file")]) from None
    except (OSError, ValueError) as e:
        reason = e.strerror if isinstance(e, OSError) else str(e)
        raise InputError([Problem(shown, None, "", f"cannot be read: {reason}", "a YAML file")]) from None
    if len(content) > MAX_BYTES:
        raise InputError([Problem(shown, None, "", f"more than {MAX_BYTES // 1024} KiB", "a smaller YAML file")])
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as e:
        line = content[: e.start].count(b"\n") + 1
        raise InputError([Problem(shown, line, "", "this is no text in UTF-8", "a YAML file")]) from None
    return read_text(text, shown)


def read_text(text: str, file: str) -> Document:
    """The mapping in YAML text; ``file`` is the name it goes by in errors. Raises InputError."""
    try:
        data, lines = _yaml_reader.read(text)
    except _yaml_reader.YamlFault as fault:
        raise InputError([Problem(file, fault.line, "", fault.wrong, fault.expected)]) from None
    if data is None:
        raise InputError([Problem(file, None, "", "the file is empty", "`key: value` lines")])
    if not isinstance(data, dict):
        raise InputError([Problem(file, lines[()], "", _described(data), "a mapping (`key: value` lines)")])
    return Document(data, lines, file)


def set_key(document: Document, key: str, value: str) -> Document:
    """The document with ``key`` (``a.b.0.c``) set to ``value``, read as YAML; missing mappings are made.

    Raises InputError where the value is no YAML or the path leads through something that has no keys.
    """
    option = f"--set {key}"
    path: list[str | int] = list(key.split("."))
    if "" in path:
        raise InputError([Problem(option, None, key, "an empty name in the key", "a dotted key such as trial.ramp")])
    try:
        parsed, _ = _yaml_reader.read(value)
    except _yaml_reader.YamlFault as fault:
        raise InputError([Problem(option, None, key, f"{fault.wrong} in {value!r}", fault.expected)]) from None
    root = here = _yaml_reader.copied(document.data)
    for i, name in enumerate(path):
        key_here = path[i] = _key_in(here, path[:i], str(name), option, key)
        if i == len(path) - 1:
            here[key_here] = parsed
        elif isinstance(here, dict) and here.get(key_here) is None:
            here[key_here] = {}
        here = here[key_here]
    done = tuple(path)
    positions = {p: place for p, place in document.positions.items() if p[: len(done)] != done}
    return Document(root, {**positions, done: option}, document.file, document.prefix)


def _key_in(here: Any, path: Sequence[str | int], name: str, option: str, key: str) -> str | int:
    """``name`` as a key of ``here``, which stands at ``path``: an index where it is a list."""
    if isinstance(here, dict):
        return name
    if isinstance(here, list):
        if name.isascii() and name.isdecimal() and len(name) < 9 and int(name) < len(here):
            return int(name)
        expected = f"an index from 0 to {len(here) - 1}" if here else "no index: the list is empty"
        raise InputError([Problem(option, None, key, f"{dotted(path)} has no item {name!r}", expected)])
    wrong = f"{dotted(path)} is {_described(here)}: it has no key {name!r}"
    raise InputError([Problem(option, None, key, wrong, f"a whole value: --set {dotted(path)}=...")])


def parse(model: type[M], document: Document, overrides: Mapping[str, str] | None = None) -> M:
    """The document as a ``model``, each override applied as by `set_key`. Raises InputError with every problem.

    Types are strict: text is no number, and neither is ``true``.
    """
    for key, value in (overrides or {}).items():
        document = set_key(document, key, value)
    try:
        return _validated(model, document.data)
    except ValidationError as e:
        found = list(islice(_faults(model, document.data, e), MOST + 1))
        unique = dict.fromkeys(document.problem(*fault) for fault in found[:MOST])
        problems = sorted(unique, key=lambda p: (p.line is None, p.line or 0))
        if len(found) > MOST:
            problems.append(Problem(document.file, None, "", "there is more that is wrong", "these put right first"))
        raise InputError(problems) from None


def validated(model: type[M], data: Any, at: KeyPath) -> M:
    """For use in a validator: ``data`` as a ``model``, or a Refusal that carries every fault, at its place."""
    try:
        return _validated(model, data)
    except ValidationError as e:
        refusal = Refusal(f"does not fit {model.__name__}", at=at)
        refusal.inner = (model, _as_lists(data), e)
        raise refusal from None


def _validated(model: type[M], data: Any) -> M:
    return model.model_validate(_as_tuples(data), strict=True)


def _as_tuples(data: Any) -> Any:
    """Lists as tuples, which is what the models' fields are: strict validation makes no difference between files."""
    if isinstance(data, dict):
        return {key: _as_tuples(value) for key, value in data.items()}
    return tuple(_as_tuples(value) for value in data) if isinstance(data, list | tuple) else data


def _as_lists(data: Any) -> Any:
    if isinstance(data, dict):
        return {key: _as_lists(value) for key, value in data.items()}
    return [_as_lists(value) for value in data] if isinstance(data, list | tuple) else data


def _faults(model: Any, data: Any, error: ValidationError) -> Iterator[tuple[KeyPath, str, str, str]]:
    """(path, wrong, expected, nearest) of each error, in the user's terms."""
    for e in error.errors(include_url=False):
        path, cut = model_paths.located(model, e["loc"], data)
        cause = e.get("ctx", {}).get("error")
        if isinstance(cause, Refusal) and cause.inner is not None:
            yield from (((*path, *cause.at, *f[0]), f[1], f[2], f[3]) for f in _faults(*cause.inner))
        elif isinstance(cause, Refusal):
            yield (*path, *cause.at), cause.wrong, cause.expected, cause.nearest
        else:
            yield _fault(model, data, path, cut, e)


def _fault(model: Any, data: Any, path: KeyPath, cut: bool, e: Any) -> tuple[KeyPath, str, str, str]:
    kind, context, parent, last = e["type"], e.get("ctx", {}), path[:-1], str(path[-1]) if path else ""
    value = _value(data, path)
    if cut:
        return path, _described(value), _words(_annotation(model, path, data)), ""
    if kind == "extra_forbidden" or "[key]" in e["loc"]:
        options = model_paths.keys(_annotation(model, parent, data), _value(data, parent))
        return path, "unknown key", one_of(options), nearest(last, options)
    if kind == "missing" and isinstance(path[-1], int):
        return parent, "too few values", _words(_annotation(model, parent, data)), ""
    if kind == "missing":
        words = _words(_annotation(model, path, data)) or "a value"
        return path, "missing key", _with_meaning(words, model, path, data), ""
    if kind in ("literal_error", "enum"):
        options = re.findall(r"'([^']*)'", context["expected"])
        close = nearest(value, options) if isinstance(value, str) else ""
        return path, f"unknown value {str(value)[:60]!r}", one_of(options), close
    if kind in ("union_tag_invalid", "union_tag_not_found"):
        name = context["discriminator"].strip("'")
        options = re.findall(r"'([^']*)'", context.get("expected_tags", ""))
        if kind == "union_tag_not_found":
            return (*path, name), "missing key", f"the kind of this entry under {name!r}", ""
        return (*path, name), f"unknown value {context['tag']!r}", one_of(options), nearest(context["tag"], options)
    if kind == "value_error":
        return path, str(context["error"]), "", ""
    return path, _described(value), _with_meaning(_expected(e["msg"]), model, path, data), ""


_EXPECTED = {
    "dictionary": "a mapping (`key: value` lines)",
    "dictionary or an instance": "a mapping (`key: value` lines)",
    "tuple": "a list in brackets",
    "number": "a number",
    "integer": "a whole number",
    "string": "text",
    "boolean": "true or false",
}


def _expected(message: str) -> str:
    """What pydantic's message says should stand there, in the words of a YAML file."""
    should = re.sub(r"^\w+ should (be (a valid )?|have )?", "", message)
    should = re.sub(r" after validation, not \d+$", "", should)
    should = re.sub(r"^match pattern", "text matching", should)
    return next((words for start, words in _EXPECTED.items() if should.startswith(start)), should)


def _annotation(model: Any, path: KeyPath, data: Any) -> Any:
    for key in path:
        model, data = model_paths.child(model, key, data)[1], model_paths.at(data, key)
    return model


def _value(data: Any, path: KeyPath) -> Any:
    for key in path:
        data = model_paths.at(data, key)
    return data


def _with_meaning(expected: str, model: Any, path: KeyPath, data: Any) -> str:
    info = model_paths.field_at(model, path, data)
    return f"{expected} ({info.description})" if info is not None and info.description else expected


_KINDS = {float: "a number", int: "a whole number", str: "text", bool: "true or false"}


def _words(annotation: Any) -> str:
    """What a value of this type looks like in the file; '' where that cannot be told."""
    words: list[str] = []
    for member in model_paths.alternatives(annotation):
        arguments = get_args(member)
        if get_origin(member) is tuple and arguments and arguments[-1] is not Ellipsis:
            words.append(f"a list of {len(arguments)}")
        elif get_origin(member) in (tuple, list):
            words.append("a list")
        elif get_origin(member) is Literal:
            words.append(one_of(arguments))
        elif get_origin(member) is dict or model_paths.is_model(member):
            words.append("a mapping (`key: value` lines)")
        else:
            words.append(_KINDS.get(member, ""))
    return " or ".join(filter(None, dict.fromkeys(words)))


def _described(value: Any) -> str:
    """A value in words short enough for a message."""
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, dict):
        return "a mapping"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    if isinstance(value, str):
        return f"text {value[:60]!r}"
    return f"the number {value!r:.60}"


def locate(
    name: str,
    kind: str,
    folders: Sequence[str | os.PathLike[str]],
    listed: Sequence[str | os.PathLike[str]] | None = None,
    besides: Collection[str] = (),
) -> Path:
    """The file that ``name`` means: a path or a bare name, looked up in the current folder, then in ``folders``.

    Raises InputError with the names in ``listed`` (default: ``folders``), the folders that hold nothing but files of
    this kind ``besides`` some, and the nearest of them. ``kind`` says in words what is looked for.
    """
    shown = (name if name.isprintable() and name else repr(name))[:200]
    searched = [Path(), *(Path(folder) for folder in folders)]
    candidates = [name] if name.endswith((".yaml", ".yml")) else [f"{name}.yaml", f"{name}.yml"]
    if Path(name).name != name:
        candidates.append(name)  # a path may have any ending; a bare name must not pick up some file of that name
    try:
        for folder in searched:
            for candidate in candidates:
                path = folder / Path(candidate).expanduser()
                if name and path.is_file():
                    return path
        shelves = [Path(folder) for folder in (folders if listed is None else listed)]
        present = {p.stem for folder in shelves if folder.is_dir() for p in folder.glob("*.yaml")} - {*besides}
        wrong = "is a folder" if name and Path(name).is_dir() else f"there is no such {kind}"
    except (OSError, ValueError, RuntimeError) as e:
        reason = e.strerror if isinstance(e, OSError) else str(e)
        raise InputError([Problem(shown, None, "", f"is no file name: {reason}", f"the file of the {kind}")]) from None
    expected = f"a path, or {one_of(present)}" if present else "a path to a YAML file"
    raise InputError([Problem(shown, None, "", wrong, expected, nearest(Path(name).stem, present))])
