"""JSON Schemas of models, for editors: draft 7, which is what the language servers of YAML read.

What a model's data alone can tell (`mechanics.model_paths`) a schema says by conditions; names that stand in folders or
registers are asked for when the schema is made.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel, GetJsonSchemaHandler
from pydantic.json_schema import models_json_schema
from pydantic_core import CoreSchema

DRAFT = "http://json-schema.org/draft-07/schema#"

Schema = dict[str, Any]

#: keys of a schema whose values are data, not schemas, and those whose values are schemas by name
_DATA, _NAMED = ("default", "const", "enum", "examples", "required"), ("properties", "definitions", "$defs")


@dataclass(frozen=True)
class Offered:
    """An annotation of text, or of a list of it: the names that an editor offers; ``only``: nothing else is valid."""

    names: Callable[[], Iterable[str]]
    only: bool = True

    def __get_pydantic_json_schema__(self, core: CoreSchema, handler: GetJsonSchemaHandler) -> Schema:
        found = handler(core)
        names = {"type": "string", "enum": sorted(self.names())}
        if found.get("type") == "array":
            return {**found, "items": names if self.only else {"anyOf": [names, found["items"]]}}
        return names if self.only else {"anyOf": [names, found]}


def reference(model: type[BaseModel], handler: GetJsonSchemaHandler) -> Schema:
    """A reference to the schema of ``model``, within a schema that is being made."""
    return handler(model.__pydantic_core_schema__)


def when(conditions: Mapping[str, Any], then: Schema) -> Schema:
    """Where each key has its value, or with None is not there, ``then`` holds, too."""
    there = [key for key, value in conditions.items() if value is not None]
    absent = [{"not": {"required": [key]}} for key, value in conditions.items() if value is None]
    fits: Schema = {"properties": {key: {"const": conditions[key]} for key in there}, "required": there}
    return {"if": {**fits, "allOf": absent} if absent else fits, "then": then}


def schemas_of(models: Iterable[type[BaseModel]]) -> tuple[list[Schema], dict[str, Schema]]:
    """A reference to each model's schema, and the definitions that they refer to, in draft 7."""
    asked = list(models)
    found, whole = models_json_schema([(model, "validation") for model in asked], ref_template="#/definitions/{model}")
    references = [_draft_7(found[model, "validation"]) for model in asked]
    return references, {name: _draft_7(one) for name, one in sorted(whole.get("$defs", {}).items())}


def schema_of(model: type[BaseModel], title: str) -> Schema:
    """The schema of files that hold a ``model``."""
    (root,), definitions = schemas_of([model])
    own = definitions.pop(root["$ref"].rpartition("/")[2])
    return {"$schema": DRAFT, **own, "title": title, "definitions": definitions}


def _draft_7(node: Any) -> Any:
    """A schema of pydantic's as draft 7 has it: its pairs and triples, and what stands beside a reference."""
    if isinstance(node, list):
        return [_draft_7(item) for item in node]
    if not isinstance(node, dict):
        return node
    out: Schema = {}
    for key, value in node.items():
        if key in _DATA:
            out[key] = value
        elif key in _NAMED:
            out[key] = {name: _draft_7(one) for name, one in value.items()}
        elif key == "prefixItems":
            out["items"], out["additionalItems"] = _draft_7(value), False
        elif key == "description":
            out[key] = re.sub(r"``(.+?)``", r"`\1`", value)  # editors show Markdown
        elif key != "discriminator":  # OpenAPI's; the models' own constants say the same
            out[key] = _draft_7(value)
    if "$ref" in out and len(out) > 1:
        out = {"allOf": [{"$ref": out.pop("$ref")}, *out.pop("allOf", [])], **out}
    return out
