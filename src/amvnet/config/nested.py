"""Convert the configuration to nested dictionaries, which YAML and JSON can hold, and back."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, TypeVar, get_args, get_type_hints

from amvnet.errors import InputError, did_you_mean, errors_of, shown

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

T = TypeVar("T", bound="DataclassInstance")
MAX_DEPTH = 20  # largest number of nested levels that `flat` follows


def merge_trees(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Return a copy of `base`, updated with `over`.

    Two dictionaries under the same key are merged in the same way. Any other value of `over`
    replaces the value of `base`.
    """
    merged = dict(base)
    for key, value in over.items():
        base_value = merged.get(key)
        if isinstance(value, Mapping) and isinstance(base_value, Mapping):
            merged[key] = merge_trees(base_value, value)
        else:
            merged[key] = value

    return merged


def from_dict(cls: type[T], tree: Any, where: str = "configuration") -> T:
    """Return a dataclass with the values of nested dictionaries.

    Args:
        cls: a dataclass; all its fields have defaults.
        tree: values by field name. The other fields keep their defaults.
        where: the beginning of error messages, such as the name of the file.

    Raises:
        InputError: if `tree` is not a dictionary, a key is not a field, a value does not have the
            type of the default, or a number is out of its range.
    """
    if not isinstance(tree, Mapping):
        raise InputError(
            f"{where}: expected keys and values, found {shown(tree)}; correct the value"
        )
    return replace_values(cls(), tree, where)


def to_dict(config: Any) -> dict[str, Any]:
    """Return a dataclass as nested dictionaries, with lists in place of tuples."""
    tree: dict[str, Any] = {}
    for key, value in vars(config).items():
        if isinstance(value, tuple):
            tree[key] = list(value)
        elif dataclasses.is_dataclass(value):
            tree[key] = to_dict(value)
        else:
            tree[key] = value

    return tree


def flat(tree: Any, name: str = "", depth: int = MAX_DEPTH) -> Iterator[tuple[str, Any]]:
    """Yield keys and values of nested dictionaries to a depth; dots join keys of several levels.

    `name` is the key of `tree` itself, if it is a part of a larger tree.
    """
    if not isinstance(tree, Mapping) or not depth:
        yield name, tree
        return
    for key, value in tree.items():
        yield from flat(value, f"{name}.{key}".removeprefix("."), depth - 1)


def replace_values(default: T, tree: Mapping[str, Any], where: str) -> T:
    """Return a copy of a dataclass with the values of nested dictionaries; see `from_dict`."""
    field_types = get_type_hints(type(default))

    changes = {}
    for key, value in tree.items():
        if key not in field_types:
            raise InputError(
                f"{where}: expected one of {', '.join(field_types)}, found {shown(key)}"
                + did_you_mean(str(key), field_types, "correct the key")
            )

        changes[key] = _convert(getattr(default, key), value, field_types[key], f"{where}: {key}")

    with errors_of(where):
        return dataclasses.replace(default, **changes)


def _convert(default: Any, value: Any, kind: Any, where: str) -> Any:
    wrong_type = InputError(
        f"{where}: expected a value like {default!r}, found {shown(value)}; correct the value"
    )
    if dataclasses.is_dataclass(default) and not isinstance(default, type):
        if not isinstance(value, Mapping):
            raise wrong_type
        return replace_values(default, value, where)

    if isinstance(default, tuple):
        if not isinstance(value, list | tuple):
            raise wrong_type
        item_kind = get_args(kind)[0]
        example = default[0] if default else _example(item_kind)
        return tuple(_convert(example, item, item_kind, where) for item in value)

    choices = get_args(kind)  # the values of a Literal; empty for any other type
    if choices:
        if value not in choices:
            raise InputError(
                f"{where}: expected one of {', '.join(choices)}, found {shown(value)}"
                + did_you_mean(str(value), choices, "correct the value")
            )

        return value

    if isinstance(default, float) and type(value) in (int, float, str):
        try:
            return float(value)  # YAML reads 2e-3, without a dot, as text
        except (ValueError, OverflowError):
            raise wrong_type from None

    if type(value) is not type(default):
        raise wrong_type
    return value


def _example(kind: Any) -> Any:
    """Return a value of the type of a tuple's items, which may be a Literal."""
    choices = get_args(kind)
    return choices[0] if choices else kind()
