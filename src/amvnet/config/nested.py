"""The configuration's dataclasses from nested dictionaries, as YAML and JSON hold them, and back."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Mapping
from typing import Any, TypeVar, cast, get_args, get_type_hints

from amvnet.errors import InputError

T = TypeVar("T")


def merge_trees(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """`base` with every leaf that `over` names replaced."""
    merged = dict(base)
    for key, value in over.items():
        below = merged.get(key)
        both = isinstance(value, Mapping) and isinstance(below, Mapping)
        merged[key] = merge_trees(cast(Mapping[str, Any], below), value) if both else value
    return merged


def from_dict(cls: type[T], tree: Any, where: str = "configuration") -> T:
    """A dataclass whose fields all have defaults, from nested dictionaries; what is not named keeps its default.

    Raises:
        InputError: on a key that is not there, a value of another kind than the default's, or out of its range.
    """
    if not isinstance(tree, Mapping):
        raise InputError(f"{where}: expected keys and values, found {tree!r}; correct the value")
    return _replace(cls(), tree, where)


def to_dict(config: Any) -> dict[str, Any]:
    """Nested dictionaries and lists of a dataclass."""
    return {k: list(v) if isinstance(v, tuple) else to_dict(v) if dataclasses.is_dataclass(v) else v
            for k, v in vars(config).items()}  # fmt: skip


def _replace(default: T, tree: Mapping[str, Any], where: str) -> T:
    kinds = get_type_hints(type(default))
    changes = {}
    for key, value in tree.items():
        if key not in kinds:
            raise InputError(
                f"{where}: expected one of {', '.join(kinds)}, found {key!r}; correct the key"
            )
        changes[key] = _value(getattr(default, key), value, kinds[key], f"{where}: {key}")
    try:
        return dataclasses.replace(cast(Any, default), **changes)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def _value(default: Any, value: Any, kind: Any, where: str) -> Any:
    if dataclasses.is_dataclass(default):
        if isinstance(value, Mapping):
            return _replace(default, value, where)
    elif isinstance(default, tuple):
        if isinstance(value, list | tuple):
            return tuple(_value(default[0], one, get_args(kind)[0], where) for one in value)
    elif allowed := get_args(kind):  # of a Literal
        if value in allowed:
            return value
        raise InputError(
            f"{where}: expected one of {', '.join(allowed)}, found {value!r}; correct the value"
        )
    elif (
        isinstance(default, float)
        and isinstance(value, int | float | str)
        and not isinstance(value, bool)
    ):
        with contextlib.suppress(ValueError):
            return float(value)  # YAML takes 2e-3 for text
    elif type(value) is type(default):
        return value
    raise InputError(
        f"{where}: expected a value like {default!r}, found {value!r}; correct the value"
    )
