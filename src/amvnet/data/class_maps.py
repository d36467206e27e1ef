"""Map classes to a few coarse classes, or to a user's own classes (docs/own_data.md)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from amvnet.config.yaml_files import parse_yaml, read_yaml
from amvnet.data.taxonomy import TAXONOMIES, Taxonomy, class_entries, user_taxonomy
from amvnet.errors import InputError, did_you_mean, errors_of, shown

BUILT_IN = ("coarse", "lidog")  # the maps in files of this package, by name


@dataclass(frozen=True)
class ClassMap:
    """A map from the names of classes (`sources`) to train ids of another taxonomy (`target`)."""

    target: Taxonomy
    sources: Mapping[str, int]

    def train_id(self, name: str) -> int:
        """Return the train id in `target` that the class of a name becomes.

        A class that the map does not name becomes the target class of the same name. If there is no
        such class, it is ignored (0).
        """
        same_name = self.target.classes.index(name) + 1 if name in self.target.classes else 0
        return self.sources.get(name, same_name)

    def names_any(self, taxonomy: Taxonomy) -> bool:
        """Return whether a class of a taxonomy becomes one of `target`."""
        return any(map(self.train_id, taxonomy.classes))

    def table(self, taxonomy: Taxonomy) -> np.ndarray:
        """Return the train ids in `target`, (K + 1,) uint8, indexed by a taxonomy's train ids.

        Raises:
            InputError: if the map names none of the classes.
        """
        if not self.names_any(taxonomy):
            raise InputError(
                f"--classes {self.target.name}: expected a map of the classes of {taxonomy.name} "
                f"({', '.join(taxonomy.classes)[:200]}), found none of them; write a YAML file"
            )

        return np.array([0, *map(self.train_id, taxonomy.classes)], dtype=np.uint8)


def class_map(name: str, *taxonomies: Taxonomy) -> ClassMap:
    """Return a built-in map or the map in a YAML file.

    Args:
        taxonomies: the classes of the weights and of the data; without any, names are not checked.

    Raises:
        InputError: if there is no such map, or it names a class that neither these nor a benchmark
            have. A map may also be for benchmarks that are not in use.
    """
    if name in BUILT_IN:
        text = (resources.files("amvnet.data") / f"{name}.yaml").read_text(encoding="utf-8")
        return _parse(name, parse_yaml(text, name))

    path = Path(name)
    if path.suffix not in (".yaml", ".yml"):
        raise InputError(
            f"--classes: expected {', '.join(BUILT_IN)} or a YAML file, found {name!r}; "
            "give one of them"
        )

    with errors_of(path):
        mapping = _parse(path.stem, read_yaml(path, "a map of classes"))
        if taxonomies:
            _check_names(mapping, (*taxonomies, *TAXONOMIES.values()))
        return mapping


def _check_names(mapping: ClassMap, taxonomies: Iterable[Taxonomy]) -> None:
    """Raise InputError if a map names a class that no taxonomy has, or nothing becomes a class."""
    known = {name for taxonomy in taxonomies for name in taxonomy.classes}
    for train_id, title in enumerate(mapping.target.classes, start=1):
        names = [name for name, target in mapping.sources.items() if target == train_id]
        for name in names or [title]:
            if name not in known:
                raise InputError(
                    f"{title}: expected classes of the weights or of the data, found {name!r}"
                    f"{did_you_mean(name, sorted(known))}"
                )


def _parse(name: str, tree: Any) -> ClassMap:
    classes = tree.get("classes") if isinstance(tree, Mapping) else None
    entries = class_entries(classes, "from", "ground: [road, sidewalk]")

    sources: dict[str, int] = {}
    raw_ids = [0]
    raw_to_train: dict[int | str, int] = {0: 0}
    for train_id, (title, values) in enumerate(entries.items(), start=1):
        names = values.get("from", [])
        for source in names if isinstance(names, list) else [names]:
            if not isinstance(source, str):
                raise InputError(
                    f"{title}: expected names of classes, found {shown(source)}; correct it"
                )
            if source in sources:
                raise InputError(f"expected each class once, found {source} twice; correct the map")
            sources[source] = train_id

        raw_id = values.get("id", train_id)
        if type(raw_id) is not int:
            raise InputError(
                f"{title}: expected a whole number as id, found {shown(raw_id)}; correct it"
            )
        raw_ids.append(raw_id)
        raw_to_train[raw_id] = train_id

    return ClassMap(user_taxonomy(name, entries, raw_to_train, raw_ids), sources)
