"""Which keys a pydantic model has, followed along a path through data that may not fit it.

A model whose key holds something that only its data can tell (a skill's parameters, by the skill's name) says so in a
class method ``submodel(key, data) -> type | None``.
"""

from __future__ import annotations

import types
from collections.abc import Iterator, Sequence
from typing import Annotated, Any, Literal, TypeGuard, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

Path = tuple[str | int, ...]


def is_model(annotation: Any) -> TypeGuard[type[BaseModel]]:
    """Whether ``annotation`` is a pydantic model class."""
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def alternatives(annotation: Any) -> list[Any]:
    """The members of a union, without None and without ``Annotated``; one element for anything else."""
    if get_origin(annotation) is Annotated:
        return alternatives(get_args(annotation)[0])
    if get_origin(annotation) in (Union, types.UnionType):
        return [m for arg in get_args(annotation) if arg is not type(None) for m in alternatives(arg)]
    return [annotation]


def chosen(annotation: Any, data: Any) -> Any:
    """The member of a union that ``data`` means: by its kind, and by the tags (single literals) of the models."""
    members = alternatives(annotation)
    if len(members) == 1:
        return members[0]
    if isinstance(data, dict):
        fitting = [m for m in members if is_model(m) and _tags_match(m, data)]
        fitting += [m for m in members if get_origin(m) is dict]
    elif isinstance(data, list):
        fitting = [m for m in members if get_origin(m) in (list, tuple)]
    else:
        fitting = [m for m in members if not is_model(m) and get_origin(m) not in (list, tuple, dict)]
    return fitting[0] if fitting else None


def _tags_match(model: type[BaseModel], data: dict[str, Any]) -> bool:
    for name, field in model.model_fields.items():
        options = get_args(field.annotation) if get_origin(field.annotation) is Literal else ()
        if len(options) == 1 and field.is_required() and data.get(name) != options[0]:
            return False
    return True


def child(annotation: Any, key: str | int, data: Any) -> tuple[bool, Any]:
    """Whether ``annotation`` admits ``key`` where ``data`` stands, and the annotation found there (None: unknown)."""
    target = chosen(annotation, data)
    if is_model(target):
        if key not in target.model_fields:
            return False, None
        below = _submodel(target, str(key), data)
        return True, target.model_fields[str(key)].annotation if below is None else below
    if get_origin(target) is dict:
        key_type, value_type = get_args(target)
        names = _literal(key_type)
        if names:
            return key in names, value_type
        known = isinstance(data, dict) and key in data
        # A new entry of a mapping of models would lack its required keys: it is a misspelt name.
        return isinstance(key, str) and (known or not any(is_model(m) for m in alternatives(value_type))), value_type
    if get_origin(target) in (list, tuple):
        index = _index(key)
        if index is None or not isinstance(data, list) or not 0 <= index < len(data):
            return False, None
        arguments = get_args(target)
        if get_origin(target) is list or (len(arguments) == 2 and arguments[1] is Ellipsis):
            return True, arguments[0]
        return (True, arguments[index]) if index < len(arguments) else (False, None)
    return False, None


def _submodel(model: Any, key: str, data: Any) -> Any:
    hook = getattr(model, "submodel", None)
    return hook(key, data) if hook is not None and isinstance(data, dict) else None


def _index(key: str | int) -> int | None:
    if isinstance(key, int):
        return key
    return int(key) if key.isdecimal() and key.isascii() and len(key) < 9 else None


def _literal(annotation: Any) -> tuple[Any, ...]:
    return get_args(annotation) if get_origin(annotation) is Literal else ()


def keys(annotation: Any, data: Any) -> list[str]:
    """The keys that may stand where ``data`` stands."""
    target = chosen(annotation, data)
    if is_model(target):
        return list(target.model_fields)
    if get_origin(target) is dict:
        names = [str(name) for name in _literal(get_args(target)[0])]
        return names or (list(data) if isinstance(data, dict) else [])
    if get_origin(target) in (list, tuple) and isinstance(data, list):
        return [str(i) for i in range(len(data))]
    return []


def at(data: Any, key: str | int) -> Any:
    """The value under ``key``, None where there is none."""
    if isinstance(data, dict):
        return data.get(key)
    index = _index(key)
    return data[index] if isinstance(data, list) and index is not None and 0 <= index < len(data) else None


def exists(annotation: Any, path: Sequence[str | int], data: Any) -> bool:
    """Whether the model has ``path``, whether or not ``data`` does."""
    for key in path:
        found, below = child(annotation, key, data)
        if not found:
            return False
        annotation, data = below, at(data, key)
    return True


def paths(annotation: Any, data: Any, prefix: Path = ()) -> Iterator[Path]:
    """Every path of the model, lists and mappings of free names as far as ``data`` fills them."""
    for key in keys(annotation, data):
        found, below = child(annotation, key, data)
        if found:
            yield (*prefix, key)
            yield from paths(below, at(data, key), (*prefix, key))


def located(annotation: Any, location: Sequence[str | int], data: Any) -> tuple[Path, bool]:
    """A pydantic error's ``loc`` as a path of keys, and whether it was cut at a union of plain values.

    pydantic puts the label of a union's member into the location. For models the label is dropped; at a union of
    plain values (a number or a pair) the location ends, for the user wrote one value.
    """
    path: list[str | int] = []
    rest = list(location)
    while rest:
        members = alternatives(annotation) if annotation is not None else []
        if len(members) > 1:
            rest.pop(0)
            annotation = chosen(annotation, data)
            if not any(is_model(m) for m in members):
                return tuple(path), True
            if not rest:
                break
        key = rest.pop(0)
        if key == "[key]":
            break
        path.append(key)
        annotation = child(annotation, key, data)[1] if annotation is not None else None
        data = at(data, key)
    return tuple(path), False


def field_at(annotation: Any, path: Path, data: Any) -> FieldInfo | None:
    """The field that ``path`` names, where its parent is a model."""
    for key in path[:-1]:
        annotation, data = child(annotation, key, data)[1], at(data, key)
    target = chosen(annotation, data) if path and annotation is not None else None
    return target.model_fields.get(str(path[-1])) if is_model(target) else None
