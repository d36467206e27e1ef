"""Open the dataset that a user names."""

from __future__ import annotations

import os
from pathlib import Path

from amvnet.data.datasets.base import Dataset
from amvnet.data.datasets.description import ENDINGS, is_description
from amvnet.data.datasets.nuscenes import NuScenes
from amvnet.data.datasets.own import OwnScans, open_own
from amvnet.data.datasets.semantickitti import SemanticKitti
from amvnet.data.datasets.simulated import CLASSES_BY_SENSOR, SimulatedStreets
from amvnet.data.taxonomy import Taxonomy, describe_difference
from amvnet.errors import InputError

Reader = type[SemanticKitti] | type[NuScenes]

READERS: dict[str, Reader] = {"semantickitti": SemanticKitti, "nuscenes": NuScenes}
OWN = "files"  # prefix of the YAML file of a user's own scans
SIMULATED = {
    f"simulated-{sensor}": sensor for sensor in CLASSES_BY_SENSOR
}  # names of sensors by prefix


def open_dataset(spec: str) -> Dataset:
    """Open a dataset.

    Args:
        spec: `semantickitti:PATH`, `nuscenes:PATH`, `nuscenes:PATH@v1.0-mini`, or a plain path with
            the layout of one of them; or `simulated-hdl64e:PATH` or `simulated-hdl32e:PATH`, for
            streets that are simulated when they are read and cached in a folder; or `files:FILE`,
            or only FILE, the YAML file that describes a user's own scans and classes.

    Raises:
        InputError: if the path does not exist or does not have the layout.
    """
    kind, _, rest = spec.partition(":")
    if kind in SIMULATED:
        return SimulatedStreets(Path(os.path.expanduser(rest)), SIMULATED[kind])
    if is_own(spec):
        return open_own(spec.removeprefix(f"{OWN}:"))

    path, version = _split_version(rest if kind in READERS else spec)
    if not path.is_dir():
        raise InputError(
            f"{path}: expected the folder of a dataset, found none{_or_description(path)}"
        )

    reader = READERS[kind] if kind in READERS else _guess_reader(path)
    if issubclass(reader, NuScenes):
        return reader(path, version)
    if version is not None:
        raise InputError(
            f"{path}: expected no version after @, found {version}; only nuScenes has versions"
        )
    return reader(path)


def open_with_classes(spec: str, taxonomy: Taxonomy) -> Dataset:
    """Open a dataset; raise InputError if it does not have these classes."""
    dataset = open_dataset(spec)
    check_classes(dataset, taxonomy)
    return dataset


def open_if_dataset(spec: str, taxonomy: Taxonomy | None) -> Dataset | None:
    """Open a dataset, with these classes if given; return None for scan files."""
    if not is_dataset(spec):
        return None

    dataset = open_dataset(spec)
    if taxonomy is None:
        return dataset
    # If their own labels are left out, a user's scans can get labels of any classes.
    if isinstance(dataset, OwnScans) and dataset.taxonomy.classes != taxonomy.classes:
        return dataset.with_classes(taxonomy)
    check_classes(dataset, taxonomy)
    return dataset


def is_own(spec: str) -> bool:
    """Return whether a text names the YAML file of a user's own scans."""
    return spec.partition(":")[0] == OWN or is_description(spec)


def is_dataset(spec: str) -> bool:
    """Return whether a text names a dataset, by its prefix or by the layout of its folder."""
    path, version = _split_version(spec)
    kind = spec.partition(":")[0]
    if kind in READERS or kind in SIMULATED or is_own(spec) or version is not None:
        return True
    return path.is_dir() and bool(_readers_of(path))


def check_classes(dataset: Dataset, taxonomy: Taxonomy) -> None:
    """Raise InputError if a dataset has other classes than a taxonomy."""
    if taxonomy.classes != dataset.taxonomy.classes:
        raise InputError(
            f"{dataset.spec}: expected weights with the classes of the data, found "
            f"{describe_difference(dataset.taxonomy.classes, taxonomy.classes, taxonomy.name)}; "
            "use weights with these classes, or map both by --classes"
        )


def _or_description(path: Path, advice: str = "check the path") -> str:
    """Return the end of a message: the YAML file that is meant by a name without its ending."""
    for ending in ENDINGS:
        described = path.with_name(path.name + ending) if path.name else path
        if is_description(str(described)):
            return f"; did you mean {described}?"
    return f"; {advice}"


def _split_version(text: str) -> tuple[Path, str | None]:
    """Split PATH@v1.0-mini; other names with an @ stay whole."""
    path, at, version = text.rpartition("@")
    if not at or not version.startswith("v1.0-") or Path(text).exists():
        return Path(os.path.expanduser(text)), None
    return Path(os.path.expanduser(path)), version


def _readers_of(path: Path) -> list[Reader]:
    """Return the readers whose layout a folder has."""
    return [reader for reader in READERS.values() if reader.matches(path)]


def _guess_reader(path: Path) -> Reader:
    """Return the only reader whose layout a folder has."""
    readers = _readers_of(path)
    if len(readers) == 1:
        return readers[0]
    found = "both" if readers else "neither"
    choices = " or ".join(f"{kind}:PATH" for kind in READERS)
    raise InputError(
        f"{path}: expected either sequences/XX/velodyne (SemanticKITTI) or v1.0-*/sample_data.json "
        f"(nuScenes), found {found}{_or_description(path, f'write {choices}')}"
    )
