"""Read YAML without the features that can execute code or take hours."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml
from yaml.reader import ReaderError

from amvnet.errors import InputError, shown

LARGEST_YAML = 50_000  # largest size of a YAML file, bytes; PyYAML takes a second for it
DEEPEST_YAML = 50  # largest number of levels of nested values in a YAML file
NUMBERS = ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float")  # PyYAML's tags of numbers


def read_yaml(path: Path, content: str) -> Any:
    """Return the content of a YAML file: dictionaries, lists, texts and numbers.

    Nothing in the file is executed. Messages name the expected content, such as "a label map".

    Raises:
        InputError: if the file cannot be read, is too large, or is not YAML.
    """
    expected = f"{path}: expected {content} (YAML)"
    try:
        size = path.stat().st_size
        if size <= LARGEST_YAML:
            return parse_yaml(path.read_text(encoding="utf-8"), expected)
    except OSError as error:
        raise InputError(f"{expected}, found {error.strerror}; check the path") from None
    except UnicodeDecodeError:
        raise InputError(f"{expected}, found text that is not UTF-8; save it as UTF-8") from None
    raise InputError(f"{expected} of at most {LARGEST_YAML} bytes, found {size}; give another file")


def parse_yaml(text: str, expected: str) -> Any:
    """Return the value of a YAML text; nothing in it is executed. Errors begin with `expected`.

    Raises:
        InputError: if the text is not YAML, has aliases or is nested deeply.
    """
    try:
        return yaml.load(text, _BoundedLoader)
    except (yaml.YAMLError, ValueError) as error:  # ValueError: numbers and dates
        raise InputError(f"{expected}, found {_fault_of_yaml(error, text)}; correct it") from None


def _fault_of_yaml(error: Exception, text: str) -> str:
    """Return in a few words what is wrong in a YAML text, and in which of its lines."""
    if isinstance(error, ReaderError):
        last = text.count("\n", 0, error.position) + 1
        first = last
        reason = f"the character {chr(error.character)!r}"
    elif isinstance(error, yaml.MarkedYAMLError) and error.problem_mark is not None:
        last = error.problem_mark.line + 1
        first = last if error.context_mark is None else error.context_mark.line + 1
        reason = (error.problem or "no YAML").replace("'<stream end>'", "the end")
    else:
        return " ".join(str(error).split())[:300]

    if "\n" not in text:
        return f"a mistake ({reason})"
    place = f"line {last}" if first == last else f"lines {first} to {last}"
    return f"a mistake in {place} ({reason})"


class _BoundedLoader(yaml.SafeLoader):
    """PyYAML's safe loader without features that can take hours or unlimited memory.

    The depth of values is limited. Aliases are refused, because ten lines with aliases can stand
    for billions of values. A key may not occur twice, because one of its values would be lost.
    Numbers such as 1:30 are refused, which YAML 1.1 takes for minutes and reads as 90.
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

    def construct_scalar(self, node: Any) -> Any:
        if node.tag in NUMBERS and ":" in node.value:
            raise yaml.YAMLError(f"{node.value[:50]}, write a number without : or a text in quotes")
        return super().construct_scalar(node)


def read_entries(path: Path) -> dict[str, Any]:
    """Return what `write_yaml` wrote; nothing if the file is missing or holds anything else."""
    try:
        entries = parse_yaml(path.read_text(), f"{path}: expected entries")
    except (OSError, ValueError):
        return {}
    return entries if isinstance(entries, dict) else {}
