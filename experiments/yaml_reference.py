"""The reference of what YAML files may say, from their JSON Schemas: a page of docs/yaml for each kind.

``python -m experiments.yaml_reference docs/yaml`` writes the pages.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from experiments.editors import KINDS

Schema = dict[str, Any]

#: a bound from here on is the integer's own, not the key's
_WIDEST = 2**53

_ABOUT = {
    "experiment": "What is planned, executed and reported, in stages. `extrinsic run` and `extrinsic check` read it.",
    "station": "The devices of a laboratory, simulated or real, and how they are reached. Most commands read one.",
    "object": "An object's outline, mass, friction and tags, in a file of its own or inside an experiment.",
    "sensor": "What the planner believes of a finger, in a file of its own or inside an experiment.",
    "profile": "How a simulated laboratory differs from what the planner believes. The key `world.profile` names one.",
    "table": "Which experiments are run, and what is made of their trials. `extrinsic table` reads it.",
}


def pages() -> Iterator[tuple[str, str]]:
    """The name and the text of every page."""
    for kind in KINDS:
        yield kind, _Page(KINDS[kind]()).text(kind)


@dataclass
class _Page:
    """One page: the file's own keys first, then the models that they name, in the order of their first mention."""

    schema: Schema
    waiting: list[str] = field(default_factory=list)

    def text(self, kind: str) -> str:
        about = f"{_ABOUT[kind]} Made from the schema, which `extrinsic schema {kind}` prints, for editors."
        parts = [f"# `{kind}` files", "", about, ""]
        root = self.schema
        if "else" in root:  # a file that a run left holds an experiment and its station under a key each
            parts += ["What a run has left of one has two keys: `experiment`, with what follows, and `station`.", ""]
            root = self._named(root["else"])
        parts += self._model(root, level="##")
        done: set[str] = set()
        while self.waiting:
            name = self.waiting.pop(0)
            if name not in done:
                done.add(name)
                parts += [f"## {name}", "", *self._model(self.schema["definitions"][name])]
        return "\n".join(parts).rstrip() + "\n"

    def _named(self, reference: Schema) -> Schema:
        return self.schema["definitions"][reference["$ref"].rpartition("/")[2]]

    def _model(self, model: Schema, path: str = "", level: str = "###") -> list[str]:
        """What a mapping may hold: its description, its keys, what is in them, and what holds where one has a value."""
        parts = [*_paragraphs(model.get("description", "")), *self._table(model)]
        for key, inner in _inline(model):
            parts += [f"{level} `{path}{key}`", "", *self._model(inner, f"{path}{key}.", level)]
        branches: dict[str, tuple[list[Schema], Schema]] = {}
        for branch in model.get("allOf", ()):
            if "then" in branch:
                branches.setdefault(json.dumps(branch["then"]), ([], branch["then"]))[0].append(branch["if"])
        for tests, then in branches.values():
            where = _where(tests)
            inner = list(_inline(then))
            if inner and len(then["properties"]) == 1:
                key, only = inner[0]
                parts += [f"{level} `{path}{key}` where {where}", "", *self._model(only, f"{path}{key}.", level)]
            else:
                place = f"`{path[:-1]}`: " if path else ""
                heading = [f"{level} {place}{where}", ""] if then.get("properties") or then.get("description") else []
                parts += [*heading, *self._model(then, path, level)]
        return parts

    def _table(self, model: Schema) -> list[str]:
        needed = model.get("required", ())
        rows = [
            f"| `{key}` | {_cell(self._type(value))} | {_default(value, needed=key in needed)} "
            f"| {_cell(value.get('description', '') if _is_short(value) else '')} |"
            for key, value in model.get("properties", {}).items()
        ]
        return ["| key | what it may be | default | |", "|---|---|---|---|", *rows, ""] if rows else []

    def _type(self, value: Any) -> str:
        """What a value may be, in words."""
        if not isinstance(value, dict) or not value:
            return "anything"
        if "$ref" in value:
            name = value["$ref"].rpartition("/")[2]
            self.waiting.append(name)
            return f"[{name}](#{name.lower()})"
        if "else" in value:
            return f"{self._type(value['then'])} or mapping, as below"
        if "anyOf" in value or "oneOf" in value:
            words = [self._type(one) for one in value.get("anyOf") or value["oneOf"]]
            return " or ".join(dict.fromkeys(words))
        if "const" in value:
            return _literal(value["const"])
        if "enum" in value:
            return ", ".join(_literal(one) for one in value["enum"])
        if "allOf" in value:
            found = [self._type(one) for one in value["allOf"] if "$ref" in one]
            return found[0] if found else "mapping, as below"
        return self._plain(value)

    def _plain(self, value: Schema) -> str:
        kind = value.get("type")
        if kind == "array":
            return self._list(value)
        if kind == "object":
            more = value.get("additionalProperties")
            if isinstance(more, dict):
                below = "allOf" in more or "properties" in more
                return "mapping, as below" if below else f"by name: {self._type(more)}"
            return "mapping, as below" if value.get("properties") else "mapping"
        if kind in ("number", "integer"):
            return kind + _range(value)
        if kind == "string" and "pattern" in value:
            return f"text like `{value['pattern']}`"
        return {"string": "text", "boolean": "`true`, `false`", "null": "`null`"}.get(str(kind), "anything")

    def _list(self, value: Schema) -> str:
        items = value.get("items", {})
        if isinstance(items, list):
            words = [self._type(one) for one in items]
            return f"{len(words)} × {words[0]}" if len(set(words)) == 1 else "[" + "; ".join(words) + "]"
        least = value.get("minItems")
        return f"list of {self._type(items)}" + (f", at least {least}" if least else "")


def _inline(model: Schema) -> Iterator[tuple[str, Schema]]:
    """The mappings that stand within this one and have no name of their own, by what leads to them."""
    for key, value in model.get("properties", {}).items():
        for one in (value, *value.get("anyOf", ()), value.get("else", {})) if isinstance(value, dict) else ():
            more = one.get("additionalProperties")
            if one.get("properties") or any("then" in branch for branch in one.get("allOf", ())):
                yield key, one
            elif isinstance(more, dict) and ("allOf" in more or "properties" in more):
                yield f"{key}.NAME", more


def _where(tests: list[Schema]) -> str:
    """When a branch holds: a key that is left out counts as its default, which another of the tests names."""
    said = [(_values(test), [key for one in test.get("allOf", ()) for key in one["not"]["required"]]) for test in tests]
    named = [values for values, absent in said if not absent] or [values for values, _ in said]
    default = " (the default)" if any(absent for _, absent in said) else ""
    return " or ".join(" and ".join(values) + default for values in named)


def _values(test: Schema) -> list[str]:
    values = {key: value["const"] for key, value in test.get("properties", {}).items() if "const" in value}
    return [f"`{key}: {_bare(value)}`" for key, value in values.items()]


def _is_short(value: Any) -> bool:
    """Whether a key's description is its own: a mapping's stands above its own table."""
    return isinstance(value, dict) and "properties" not in value


def _paragraphs(text: str) -> list[str]:
    return [line for part in re.split(r"\n\s*\n", text.strip()) if part for line in (" ".join(part.split()), "")]


def _default(value: Any, *, needed: bool) -> str:
    if needed:
        return "**needed**"
    if not isinstance(value, dict) or "default" not in value:
        return ""
    default = value["default"]
    if isinstance(default, dict):
        return "as there" if default else "none"
    return _literal(default) if default != [] else "none"


def _literal(value: Any) -> str:
    return f"`{_bare(value)}`"


def _bare(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, list):
        return "[" + ", ".join(_bare(one) for one in value) + "]"
    if value == "":
        return '""'
    return f"{value:g}" if isinstance(value, float) else str(value)


def _range(value: Schema) -> str:
    low, high = value.get("minimum", value.get("exclusiveMinimum")), value.get("maximum", value.get("exclusiveMaximum"))
    low, high = (None if end is not None and abs(end) >= _WIDEST else end for end in (low, high))
    if low is not None and high is not None:
        opening, closing = "[" if "minimum" in value else "(", "]" if "maximum" in value else ")"
        return f" in {opening}{low:g}, {high:g}{closing}"
    if low is not None:
        return f" {'≥' if 'minimum' in value else '>'} {low:g}"
    return "" if high is None else f" {'≤' if 'maximum' in value else '<'} {high:g}"


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


def main(folder: Path) -> None:
    """Write the pages into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in pages():
        (folder / f"{name}.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
