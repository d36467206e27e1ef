"""Open the dataset that a user names."""

from __future__ import annotations

import os
from pathlib import Path

from amvnet.data.datasets.base import Dataset
from amvnet.data.datasets.description import ENDINGS, is_description
from amvnet.data.datasets.files import ScanFiles
from amvnet.data.datasets.nuscenes import NuScenes
from amvnet.data.datasets.own import OwnScans, open_own
from amvnet.data.datasets.semantickitti import SemanticKitti
from amvnet.data.taxonomy import CLASSES_BY_SENSOR, Taxonomy, check_classes
from amvnet.errors import InputError

Reader = type[SemanticKitti] | type[NuScenes]

READERS: dict[str, Reader] = {"semantickitti": SemanticKitti, "nuscenes": NuScenes}
DEEPEST = 3  # number of folders from a dataset down to its deepest: sequences/08/velodyne
OWN = "files"  # prefix of the YAML file of a user's own scans
# Prefixes of simulated streets, each with the name of its sensor.
SIMULATED = {f"simulated-{sensor}": sensor for sensor in CLASSES_BY_SENSOR}


def open_dataset(spec: str, classes: Taxonomy | None = None) -> Dataset:
    """Open a dataset.

    Args:
        spec: `semantickitti:PATH`, `nuscenes:PATH`, `nuscenes:PATH@v1.0-mini`, or a plain path with
            the layout of one of them; or `simulated-NAME:PATH`, with a name in `CLASSES_BY_SENSOR`,
            for streets that are simulated when they are read and cached in a folder; or
            `files:FILE`, or only FILE, the YAML file that describes a user's own scans and classes.
        classes: the classes that the dataset must have, for example the classes of weights. A
            user's own scans can be opened with any classes; labels of other classes are not read.

    Raises:
        InputError: if the path does not exist or does not have the layout, or the dataset has other
            classes.
    """
    dataset = _open(spec)
    return dataset if classes is None else with_classes(dataset, classes)


def with_classes(dataset: Dataset, classes: Taxonomy) -> Dataset:
    """Return a dataset with the given classes, as `open_dataset(spec, classes)` opens it.

    Raises:
        InputError: if the dataset is a benchmark with other classes.
    """
    if dataset.taxonomy.classes == classes.classes:
        return dataset
    if isinstance(dataset, OwnScans | ScanFiles):
        return dataset.with_classes(classes)
    check_classes(dataset.spec, dataset.taxonomy, classes)
    return dataset


def is_dataset(spec: str) -> bool:
    """Return whether a text names a dataset, by its prefix or by the layout of its folder."""
    if spec.partition(":")[0] in (*READERS, *SIMULATED) or _is_own(spec):
        return True
    path, version = _split_version(spec)
    return version is not None or (path.is_dir() and bool(_readers_of(path)))


def undescribed(spec: str) -> Path | None:
    """Return the folder that a text names if no layout and no YAML file says what is in it.

    Return None if the text names no folder, or `open_dataset` knows what to name instead.
    """
    path = Path(os.path.expanduser(spec))
    if not path.is_dir() or is_dataset(spec) or _did_you_mean_file(path) or _advice_for(path):
        return None
    return path


def _open(spec: str) -> Dataset:
    kind, _, rest = spec.partition(":")
    if kind in SIMULATED:
        from amvnet.data.datasets.simulated import SimulatedStreets

        return SimulatedStreets(Path(os.path.expanduser(rest)), SIMULATED[kind])
    if _is_own(spec):
        return open_own(spec.removeprefix(f"{OWN}:"))

    path, version = _split_version(rest if kind in READERS else spec)
    if not path.is_dir():
        if spec.lower().endswith(ENDINGS):
            return open_own(spec)  # raises the error for a YAML file that does not exist
        raise InputError(
            f"{path}: expected the folder of a dataset, found none"
            + (_did_you_mean_file(path) or "; check the path")
        )

    reader = READERS[kind] if kind in READERS else _guess_reader(path)
    if issubclass(reader, NuScenes):
        return reader(path, version)
    if version is not None:
        raise InputError(
            f"{path}: expected no version after @, found {version}; only nuScenes has versions"
        )
    return reader(path)


def _is_own(spec: str) -> bool:
    """Return whether a text names the description of a user's own scans."""
    return spec.partition(":")[0] == OWN or is_description(spec)


def _did_you_mean_file(path: Path) -> str:
    """Return the end of a message that asks for the YAML file of a folder; "" if there is none."""
    for ending in ENDINGS:
        file = f"{path}{ending}"
        if is_description(file):
            return f"; did you mean {file}?"
    return ""


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
    expected = "either sequences/XX/velodyne (SemanticKITTI) or v1.0-*/sample_data.json (nuScenes)"
    if readers:
        kinds = " or ".join(f"{kind}:PATH" for kind in READERS)
        raise InputError(f"{path}: expected {expected}, found both; write {kinds}")
    advice = _advice_for(path) or f"`amvnet check {path}` begins a YAML file that describes it"
    raise InputError(
        f"{path}: expected {expected}, found neither{_did_you_mean_file(path) or f'; {advice}'}"
    )


def _advice_for(path: Path) -> str:
    """Return what to give instead of a folder that has the layout of no dataset; "" if unknown."""
    folder = path.absolute()
    for parent in folder.parents[:DEEPEST]:
        # That the parent is a dataset is not enough: this folder may lie beside the dataset's own.
        if any(reader.holds(parent, folder) for reader in READERS.values()):
            return f"give the folder of the whole dataset, {parent}"
    described = [file for file in sorted(path.iterdir()) if file.suffix.lower() in ENDINGS]
    if described:
        return f"give the YAML file that describes the scans, such as {described[0]}"
    return ""
