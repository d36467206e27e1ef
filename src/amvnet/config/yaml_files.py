"""Read YAML without the features that can execute code, take hours or alter what is written."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml
from yaml.reader import ReaderError

from amvnet.errors import InputError, shown

LARGEST_YAML = 50_000  # largest size of a YAML file, bytes; PyYAML takes a second for it
DEEPEST_YAML = 50  # largest number of levels of nested values in a YAML file
LONGEST_FAULT = 300  # largest part of PyYAML's own message in a message, characters

# What YAML 1.1 calls numbers or dates although people mean names: 07 would be 7, 010 would be 8,
# 1:30 would be 90, and the folders 2011_09_26 and 2024-05-01 a number and a date.
UNUSUAL_NUMBER = re.compile(r"[-+]?0\d|.*[:_]")
TAG = "tag:yaml.org,2002:"  # begins the tags of YAML's own types


def read_yaml(path: Path, content: str) -> Any:
    """Return the content of a YAML file: dictionaries, lists, texts and numbers.

    Nothing in the file is executed. `content` names what the file should hold, for messages, such
    as "a label map".

    Raises:
        InputError: if the file cannot be read, is too large, or is not YAML.
    """
    expected = f"{path}: expected {content} (YAML)"
    try:
        size = path.stat().st_size
        if size > LARGEST_YAML:
            raise InputError(
                f"{expected} of at most {LARGEST_YAML} bytes, found {size}; give another file"
            )
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise InputError(f"{expected}, found no such file; check the path") from None
    except OSError as error:
        raise InputError(f"{expected}, found {error.strerror}; check the path") from None
    except UnicodeDecodeError:
        raise InputError(f"{expected}, found text that is not UTF-8; save it as UTF-8") from None
    return parse_yaml(text, expected)


def read_entries(path: Path) -> dict[str, Any]:
    """Return the entries that `files.write_yaml` wrote; none if the file is missing or broken."""
    try:
        entries = parse_yaml(path.read_text(), str(path))
    except (OSError, ValueError):
        return {}
    return entries if isinstance(entries, dict) else {}


def parse_yaml(text: str, expected: str) -> Any:
    """Return the value of a YAML text; nothing in it is executed.

    Args:
        expected: the beginning of an error's message, such as "a.yaml: expected a recipe".

    Raises:
        InputError: if the text is not YAML, has aliases or is nested deeply.
    """
    try:
        return yaml.load(text, _BoundedLoader)
    except (yaml.YAMLError, ValueError) as error:  # ValueError if a number has too many digits
        raise InputError(f"{expected}, found {_fault_of_yaml(error, text)}; correct it") from None


def _fault_of_yaml(error: Exception, text: str) -> str:
    """Return in a few words what is wrong in a YAML text, and in which of its lines."""
    if isinstance(error, ReaderError):
        last_line = text.count("\n", 0, error.position) + 1
        first_line = last_line
        reason = f"the character {chr(error.character)!r}"
    elif isinstance(error, yaml.MarkedYAMLError) and error.problem_mark is not None:
        last_line = error.problem_mark.line + 1
        first_line = last_line if error.context_mark is None else error.context_mark.line + 1
        reason = (error.problem or "no YAML").replace("'<stream end>'", "the end")
    else:
        return " ".join(str(error).split())[:LONGEST_FAULT]

    if "\n" not in text:
        return f"a mistake ({reason})"
    lines = f"lines {first_line} to {last_line}" if first_line < last_line else f"line {last_line}"
    return f"a mistake in {lines} ({reason})"


class _BoundedLoader(yaml.SafeLoader):
    """PyYAML's safe loader without features that take hours or memory, or alter what is written.

    The depth of values is limited. Aliases are refused, because ten lines with aliases can stand
    for billions of values. A key may not occur twice, because one of its values would be lost.
    Dates and an `UNUSUAL_NUMBER` stay texts.
    """

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self._depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            alias = self.peek_event()  # type: ignore[no-untyped-call]
            raise yaml.YAMLError(f"the alias *{alias.anchor[:50]}, write its value out")
        if self._depth == DEEPEST_YAML:
            raise yaml.YAMLError(f"more than {DEEPEST_YAML} levels")
        self._depth += 1
        node = super().compose_node(parent, index)
        self._depth -= 1

        return node

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        # Call PyYAML first, because it checks the kinds of the nodes.
        mapping = super().construct_mapping(node, deep)
        keys = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if key in keys:
                raise yaml.YAMLError(f"the key {shown(key)} twice")
            keys.add(key)
        return mapping

    def resolve(self, kind: Any, value: Any, implicit: Any) -> Any:
        tag = super().resolve(kind, value, implicit)  # type: ignore[no-untyped-call]
        is_number = tag in (f"{TAG}int", f"{TAG}float")
        if tag == f"{TAG}timestamp" or (is_number and UNUSUAL_NUMBER.match(value)):
            return f"{TAG}str"
        return tag
