"""Check predictions by the rules of a benchmark's server, and pack them into an archive.

The rules are those of the official checkers: `validate_submission.py` (task "segmentation") and
`evaluate_semantics.py` of PRBonn/semantic-kitti-api, and
`python-sdk/nuscenes/eval/lidarseg/validate_submission.py` of nutonomy/nuscenes-devkit.
"""

from __future__ import annotations

import json
import stat
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from amvnet.data.datasets.base import Dataset
from amvnet.data.datasets.nuscenes import NuScenes
from amvnet.data.datasets.semantickitti import SemanticKitti
from amvnet.data.labels.ids import check_size, train_ids
from amvnet.data.recordings import ScanFile
from amvnet.data.taxonomy import Taxonomy
from amvnet.errors import InputError, listed
from amvnet.files import Signature, atomic_write
from amvnet.progress import Progress, no_progress

# The number of test scans of SemanticKITTI (KITTI odometry 11 to 21). The server expects all of
# them.
TEST_SCANS = 20_351

# What a method uses, as submission.json of nuScenes declares it.
LIDAR_ALONE = {
    "use_camera": False,
    "use_lidar": True,
    "use_radar": False,
    "use_map": False,
    "use_external": False,
}

ENDING = ".zip"
# The compression level of deflate. Level 9 takes five to eight times as long, and saves a sixth.
LEVEL = 6
# The time of every entry. It is fixed, so that the same content gives the same bytes.
LONG_AGO = (1980, 1, 1, 0, 0, 0)
# Archives begin with the entry of a folder.
ARCHIVE = Signature("an archive of submit", rb"PK\x03\x04.{26}(sequences|lidarseg)/PK")
UNIX = 3  # ZIP's code for entries that Unix wrote
FOLDER_BIT = 0x10  # the bit of an entry's MS-DOS attributes that marks a folder


@dataclass(frozen=True)
class Rules:
    """What an archive must and may contain.

    Attributes:
        points: the number of points of each required prediction, by the name of its file.
        unlabelled: whether points may have no class (train id 0).
        folders: names of the entries for folders, outer folders first, each with a trailing slash.
        meta: name of submission.json, which declares what the method uses; None if the benchmark
            asks for no such file.
        official: the number of predictions that the server expects; None if any number will do.
    """

    taxonomy: Taxonomy
    points: Mapping[str, int]
    dtype: type[np.unsignedinteger]
    unlabelled: bool
    folders: tuple[str, ...]
    meta: str | None = None
    official: int | None = None

    def check_ids(self, data: bytes, path: Path) -> None:
        """Raise InputError if a prediction has an id that is not allowed."""
        ids = train_ids(path, np.frombuffer(data, dtype=self.dtype), self.taxonomy)
        if not self.unlabelled and not ids.all():
            raise InputError(
                f"{path}: expected a class 1..{self.taxonomy.size} for every point, "
                f"found 0 for {np.count_nonzero(ids == 0)} of {len(ids)}; "
                "give these points a class"
            )


def rules_for(dataset: Dataset, split: str, sequences: Sequence[str] | None = None) -> Rules:
    """Return the rules for the archive of one split, or of some sequences.

    Raises:
        InputError: if the dataset's benchmark has no server, or the dataset has no such scans.
    """
    if type(dataset) not in RULES:
        raise InputError(
            f"{dataset.root}: expected SemanticKITTI or nuScenes, found another dataset; "
            "give one of them"
        )

    return RULES[type(dataset)](dataset, split, sequences)


def _semantickitti(dataset: SemanticKitti, split: str, sequences: Sequence[str] | None) -> Rules:
    """Return the rules of SemanticKITTI.

    The archive holds sequences/11 to 21, each with predictions/NNNNNN.label: raw ids as uint32.

    The official validator requires a name that ends in .zip, an entry for every folder, a file for
    every scan in the `velodyne` folders, and 4 bytes per point. It does not check the ids. The
    server's evaluation reads unknown ids as "unlabeled", and stops at ids above 358. Here, unknown
    ids are errors. A point may be unlabelled, but then counts as missed. The upper 16 bits of an id
    are free.
    """
    wanted = dataset.taxonomy.splits[split] if sequences is None else sorted(set(sequences))
    folders = ["sequences/"]
    for sequence in wanted:
        folders += [f"sequences/{sequence}/", f"sequences/{sequence}/predictions/"]

    is_whole_test = split == "test" and sequences is None
    return Rules(
        taxonomy=dataset.taxonomy,
        points=_count_points(dataset, dataset.records(wanted)),
        dtype=np.uint32,
        unlabelled=True,
        folders=tuple(folders),
        official=TEST_SCANS if is_whole_test else None,
    )


def _nuscenes(dataset: NuScenes, split: str, sequences: Sequence[str] | None) -> Rules:
    """Return the rules of nuScenes-lidarseg.

    The archive holds lidarseg/SPLIT/TOKEN_lidarseg.bin, classes 1..16 as uint8, and
    SPLIT/submission.json. TOKEN is the sample_data token of LIDAR_TOP.

    The official validator requires a file for every key frame that the tables list for the split,
    with one byte of 1..16 for each point. In submission.json it requires a "meta" with exactly the
    five keys of `LIDAR_ALONE`, each true or false.
    """
    scenes = dataset.scenes(split) if sequences is None else sequences
    if not scenes:
        raise InputError(
            f"{dataset.root}: expected scenes of the {split} split, "
            f"found none in {dataset.version}; give the data of that split, "
            "or name another split with --split"
        )

    records = dataset.records(scenes)
    splits = {record.prediction.split("/")[1] for record in records}
    if len(splits) != 1:
        raise InputError(
            f"{dataset.root}: expected scenes of one split, found {', '.join(sorted(splits))}; "
            "name scenes of only one split"
        )

    (only_split,) = splits
    return Rules(
        taxonomy=dataset.taxonomy,
        points=_count_points(dataset, records),
        dtype=np.uint8,
        unlabelled=False,
        folders=("lidarseg/", f"lidarseg/{only_split}/", f"{only_split}/"),
        meta=f"{only_split}/submission.json",
    )


RULES: Mapping[type, Callable[..., Rules]] = {SemanticKitti: _semantickitti, NuScenes: _nuscenes}


def _count_points(dataset: Dataset, records: Sequence[ScanFile]) -> dict[str, int]:
    return {record.prediction: dataset.count_points(record) for record in records}


def write_archive(
    rules: Rules,
    folder: Path,
    out: Path,
    use_external: bool = False,
    progress: Progress = no_progress,
) -> int:
    """Check the predictions in a folder and pack them; return their number.

    The same predictions give the same bytes. Files that do not belong in the archive, such as
    scores or other splits, are left out. Only one scan at a time is in memory.

    Args:
        folder: folder with the predictions, under the file names of `rules`.
        out: the archive, NAME.zip. It appears whole or not at all.
        use_external: whether the method also learnt from data outside the benchmark. Only archives
            for nuScenes state it.

    Raises:
        InputError: if a prediction is missing or breaks the rules, or the archive cannot be
            written.
    """
    if out.suffix != ENDING:
        raise InputError(
            f"{out}: expected a name that ends in {ENDING}, "
            f"found {out.suffix or 'no ending'}; rename it"
        )
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of predictions, found none; check the path")

    names = sorted(rules.points)
    missing = [name for name in names if not (folder / name).is_file()]
    if missing:
        raise InputError(
            f"{folder}: expected a prediction for each of {len(names)} scans, "
            f"found no {listed(missing, 1)}; predict these scans too, "
            "or select predicted ones with --sequences or --split"
        )
    for name in names:
        size = (folder / name).stat().st_size
        check_size(folder / name, size, rules.points[name], rules.dtype)

    with atomic_write(out) as part, zipfile.ZipFile(part, "w") as archive:
        for name in rules.folders:
            _add(archive, name, b"")
        if rules.meta is not None:
            meta = {**LIDAR_ALONE, "use_external": use_external}
            _add(archive, rules.meta, json.dumps({"meta": meta}).encode())

        for done, name in enumerate(names):
            progress(done, len(names))
            data = (folder / name).read_bytes()
            rules.check_ids(data, folder / name)
            _add(archive, name, data)

    progress(len(names), len(names))
    return len(names)


def _add(archive: zipfile.ZipFile, name: str, data: bytes) -> None:
    """Add a file or a folder (NAME/) as an entry that is the same on all systems."""
    entry = zipfile.ZipInfo(name, LONG_AGO)
    entry.create_system = UNIX

    if name.endswith("/"):
        entry.external_attr = (stat.S_IFDIR | 0o755) << 16 | FOLDER_BIT
    else:
        entry.external_attr = (stat.S_IFREG | 0o644) << 16
        entry.compress_type = zipfile.ZIP_DEFLATED

    archive.writestr(entry, data, compresslevel=LEVEL)
