"""The documentation of the fields of dataclasses, from their source."""

from __future__ import annotations

import ast
import functools
import inspect
import sys
from itertools import pairwise


def field_texts(cls: type) -> dict[str, str]:
    """Return the line of documentation under each field of a dataclass."""
    texts: dict[str, str] = {}
    for field, text in pairwise(_class_bodies(cls.__module__)[cls.__name__]):
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
            texts[field.target.id] = text.value.value  # type: ignore[attr-defined,union-attr]
    return texts


@functools.cache
def _class_bodies(module: str) -> dict[str, list[ast.stmt]]:
    """Return the statements of each class of a module, by name."""
    tree = ast.parse(inspect.getsource(sys.modules[module]))
    return {node.name: node.body for node in tree.body if isinstance(node, ast.ClassDef)}
