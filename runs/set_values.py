"""Set values of the model in a weights file whose parameters stay as they are.

    python runs/set_values.py FILE KEY VALUE [KEY VALUE ...]

A key is as in a recipe without `model`: `assertion.lead 3` lets the head classify only disputed
points. Parameters must not depend on the value.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from amvnet.config.nested import replace_values
from amvnet.weights.file import read, save


def set_value(path: Path, key: str, value: Any) -> None:
    """Set one value in a weights file."""
    weights = read(path)
    tree = value
    for name in reversed(key.split(".")):
        tree = {name: tree}
    changed = replace(weights, model=replace_values(weights.model, tree, "model"))
    changed.build()  # raises if the parameters no longer fit
    save(changed, path)


if __name__ == "__main__":
    for key, value in zip(sys.argv[2::2], sys.argv[3::2], strict=True):
        set_value(Path(sys.argv[1]), key, yaml.safe_load(value))
