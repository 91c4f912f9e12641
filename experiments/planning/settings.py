"""Models of settings that are written down elsewhere as dataclasses: optimisers' settings, weights of the losses."""

from __future__ import annotations

from dataclasses import MISSING, Field, fields, is_dataclass
from enum import Enum
from functools import cache
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from pydantic import BaseModel, ConfigDict, create_model

from experiments import registries

_CONFIG = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
_PLAIN = (bool, int, float, str, type(None))


def model_of(cls: type, model_name: str, **more: Any) -> type[BaseModel]:
    """A model with the fields of the dataclass ``cls`` that a YAML file can hold, and those in ``more``."""
    assert is_dataclass(cls)
    hints = get_type_hints(cls)
    found: dict[str, Any] = {
        one.name: (hints[one.name], _default(one)) for one in fields(cls) if one.init and _is_plain(hints[one.name])
    }
    return create_model(
        model_name,
        __config__=_CONFIG,
        __doc__=cls.__doc__,
        **{**more, **{key: value for key, value in found.items() if key not in more}},
    )


@cache
def optimiser_model(name: str) -> type[BaseModel]:
    """The settings of an optimiser, and its name."""
    tag: Any = Literal[name]
    return model_of(registries.optimisers()[name], f"{name}_settings", name=(tag, name))


def _default(field: Field) -> Any:
    if field.default_factory is not MISSING:
        return field.default_factory()
    return ... if field.default is MISSING else field.default


def _is_plain(hint: Any) -> bool:
    """Whether values of this type can stand in a YAML file: text, figures, and lists of them."""
    if get_origin(hint) in (Union, UnionType):
        return all(_is_plain(member) for member in get_args(hint))
    if get_origin(hint) is Literal:
        return True
    if get_origin(hint) is tuple:
        return all(_is_plain(member) for member in get_args(hint) if member is not Ellipsis)
    return isinstance(hint, type) and (hint in _PLAIN or issubclass(hint, Enum))
