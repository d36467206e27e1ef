"""From what a user writes to an open data set."""

from __future__ import annotations

from pathlib import Path

from amvnet.data.datasets.base import Dataset, ScanRecord
from amvnet.data.datasets.nuscenes import NuScenes
from amvnet.data.datasets.semantickitti import SemanticKitti
from amvnet.data.taxonomy import Taxonomy
from amvnet.errors import InputError

__all__ = ["Dataset", "ScanRecord", "is_dataset", "open_dataset"]

KINDS: dict[str, type[SemanticKitti] | type[NuScenes]] = {
    "semantickitti": SemanticKitti,
    "nuscenes": NuScenes,
}


def open_dataset(spec: str, taxonomy: Taxonomy | None = None) -> Dataset:
    """Open a data set.

    Args:
        spec: `semantickitti:PATH`, `nuscenes:PATH`, `nuscenes:PATH@v1.0-mini`, or a plain path
            whose layout says which of them it is.
        taxonomy: the classes, where they are not the benchmark's own.

    Raises:
        InputError: where the path is not there or does not have the layout.
    """
    kind, _, place = str(spec).partition(":")
    if kind not in KINDS:
        kind, place = "", str(spec)
    path, version = _split_version(place)
    if not path.is_dir():
        raise InputError(f"{path}: expected the folder of a data set, found none; check the path")
    return _open(KINDS[kind] if kind else _guess(path), path, version, taxonomy)


def is_dataset(spec: str) -> bool:
    """Whether a text names a data set, by its prefix or by the layout of its folder, rather than scan files."""
    path, version = _split_version(spec)
    named = spec.partition(":")[0] in KINDS or version is not None
    return named or (path.is_dir() and any(opener.matches(path) for opener in KINDS.values()))


def _split_version(place: str) -> tuple[Path, str | None]:
    """Split PATH@v1.0-mini; other names with an @ stay whole."""
    path, at, version = place.rpartition("@")
    if not at or not version.startswith("v1.0-") or Path(place).exists():
        return Path(place).expanduser(), None
    return Path(path).expanduser(), version


def _guess(path: Path) -> type[SemanticKitti] | type[NuScenes]:
    found = [opener for opener in KINDS.values() if opener.matches(path)]
    if len(found) == 1:
        return found[0]
    raise InputError(
        f"{path}: expected either sequences/XX/velodyne (SemanticKITTI) or v1.0-*/sample_data.json (nuScenes), "
        f"found {'both' if found else 'neither'}; write {' or '.join(f'{kind}:PATH' for kind in KINDS)}"
    )


def _open(
    opener: type[SemanticKitti] | type[NuScenes],
    path: Path,
    version: str | None,
    taxonomy: Taxonomy | None,
) -> Dataset:
    options = {} if taxonomy is None else {"taxonomy": taxonomy}
    if issubclass(opener, NuScenes):
        return opener(path, version=version, **options)
    if version is not None:
        raise InputError(
            f"{path}: expected no version after @, found {version}; only nuScenes has versions"
        )
    return opener(path, **options)
