"""What each benchmark's server wants in an archive: which files, how large, with which ids.

The rules are those of the official checkers: `validate_submission.py` (task "segmentation") and `evaluate_semantics.py`
of PRBonn/semantic-kitti-api, `python-sdk/nuscenes/eval/lidarseg/validate_submission.py` of nutonomy/nuscenes-devkit.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from amvnet.data import scan_files as files
from amvnet.data.datasets.base import Dataset, ScanRecord
from amvnet.data.datasets.nuscenes import NuScenes
from amvnet.data.datasets.predictions import check_size, train_ids
from amvnet.data.datasets.semantickitti import SemanticKitti
from amvnet.data.taxonomy import Taxonomy
from amvnet.errors import InputError

# Scans of SemanticKITTI's test sequences (KITTI odometry 11 to 21); its server wants every one.
TEST_SCANS = {"11": 921, "12": 1061, "13": 3281, "14": 631, "15": 1901, "16": 1731, "17": 491, "18": 1801, "19": 4981,
              "20": 831, "21": 2721}  # fmt: skip
MOST_POINTS = (
    1_000_000  # of a scan that is not on disk; a full turn of these sensors has 130,000 at most
)
MOST_TEXT = 1_000_000  # bytes of a description or of submission.json


@dataclass(frozen=True)
class Sources:
    """What a method was given, as nuScenes' submission.json says it."""

    use_camera: bool = False
    use_lidar: bool = True
    use_radar: bool = False
    use_map: bool = False
    use_external: bool = False

    def to_json(self) -> bytes:
        return json.dumps({"meta": asdict(self)}).encode()


@dataclass(frozen=True)
class Rules:
    """What an archive must have in it and what it may have.

    Attributes:
        taxonomy: the classes.
        what: the scans in words.
        points: name of every prediction that may be there -> points of its scan, None where that is not on disk.
        required: the names of those that must be there.
        dtype: of the ids.
        unlabelled: whether a point may go without a class.
        folders: the folders, those above first, each with its last slash.
        needs_folders: whether they must have entries of their own.
        meta: name of the file of `Sources`, or None.
        texts: names that may be there as well.
        official: how many predictions the server wants, or None where it has no such number.
    """

    taxonomy: Taxonomy
    what: str
    points: Mapping[str, int | None]
    required: Collection[str]
    dtype: type[np.unsignedinteger]
    unlabelled: bool
    folders: tuple[str, ...]
    needs_folders: bool
    meta: str | None = None
    texts: tuple[str, ...] = ()
    official: int | None = None

    @property
    def others(self) -> tuple[str, ...]:
        """The names that are no predictions."""
        return self.texts if self.meta is None else (*self.texts, self.meta)

    def check_size(self, name: str, size: int, shown: str) -> None:
        """Check the bytes that a file has, or declares to have.

        Args:
            name: as the archive has it.
            size: in bytes.
            shown: what the message begins with.

        Raises:
            InputError: where a prediction has not one id per point, or another file is too large.
        """
        if name in self.others:
            if size > MOST_TEXT:
                raise InputError(
                    f"{shown}: expected at most {MOST_TEXT} bytes of text, found {size}; shorten it"
                )
            return
        count, width = self.points[name], np.dtype(self.dtype).itemsize
        if count is not None:
            check_size(shown, size, count, self.dtype)
        elif not 0 < size <= MOST_POINTS * width or size % width:
            raise InputError(
                f"{shown}: expected 1 to {MOST_POINTS} ids of {width} bytes, found {size} bytes; write a scan's ids"
            )

    def check_content(self, name: str, data: bytes, shown: str) -> None:
        """Check what is in a file of the right size; the arguments are those of `check_size`.

        Raises:
            InputError: where an id is not the benchmark's, or submission.json does not say what it must.
        """
        if name == self.meta:
            check_sources(data, shown)
        elif name in self.points:
            ids = train_ids(shown, np.frombuffer(data, dtype=self.dtype), self.taxonomy)
            if not self.unlabelled and not ids.all():
                raise InputError(
                    f"{shown}: expected a class 1..{self.taxonomy.size} for every point, found 0 for "
                    f"{np.count_nonzero(ids == 0)} of {len(ids)}; give these points a class"
                )


def rules_for(dataset: Dataset, split: str, sequences: Sequence[str] | None = None) -> Rules:
    """The rules for the archive of one split, or of some sequences.

    Args:
        dataset: its scans are the reference for what must be there and how many points each has.
        split: "test" is what the servers score; the others are for trials.
        sequences: of all scans, those of these sequences or scenes alone.

    Raises:
        InputError: where the data set is of no benchmark with a server, or has no such scans.
    """
    if type(dataset) not in RULES:
        raise InputError(
            f"{dataset.root}: expected SemanticKITTI or nuScenes, found another data set; give one of them"
        )
    return RULES[type(dataset)](dataset, split, sequences)


def _semantickitti(dataset: SemanticKitti, split: str, sequences: Sequence[str] | None) -> Rules:
    """SemanticKITTI: sequences/11 to 21, each with predictions/NNNNNN.label, raw ids as uint32.

    The official validator wants a name that ends in .zip, an entry for every folder, a file for every scan in the
    `velodyne` folders, and 4 bytes a point. It does not look at ids, nor at what else is there; the server's
    evaluation counts all label files, reads ids that it does not know as "unlabeled" and stops at those above 358, so
    here both are faults. A point may be unlabelled (it counts as missed) and the upper 16 bits are free. The
    description.txt is optional.
    """
    wanted = dataset.taxonomy.splits[split] if sequences is None else tuple(sorted(set(sequences)))
    present = dataset.sequences("all")
    away = [s for s in wanted if s in TEST_SCANS and s not in present] if sequences is None else []
    records = dataset.records([s for s in wanted if s not in away])
    points = {r.prediction: _points(r, files.KITTI_COLUMNS) for r in records}
    official = {
        s: [f"sequences/{s}/predictions/{i:06d}.label" for i in range(TEST_SCANS.get(s, 0))]
        for s in wanted
    }
    required = {*points, *(name for s in away for name in official[s])}
    folders = (
        "sequences/",
        *(f"sequences/{s}/{inner}" for s in wanted for inner in ("", "predictions/")),
    )
    return Rules(
        taxonomy=dataset.taxonomy,
        what=_what(split, sequences),
        points={name: None for names in official.values() for name in names} | points,
        required=required,
        dtype=np.uint32,
        unlabelled=True,
        folders=folders,
        needs_folders=True,
        texts=("description.txt", "sequences/description.txt"),
        official=sum(TEST_SCANS.values()) if split == "test" and sequences is None else None,
    )


def _nuscenes(dataset: NuScenes, split: str, sequences: Sequence[str] | None) -> Rules:
    """nuScenes-lidarseg: lidarseg/SPLIT/TOKEN_lidarseg.bin, classes 1..16 as uint8, and SPLIT/submission.json.

    TOKEN is that of the sample_data of LIDAR_TOP. The official validator wants a file for every key frame that the
    tables list in the split, a byte for every point, no byte 0 or above 16, and in submission.json a "meta" with
    exactly the five keys of `Sources`, all true or false. It does not look at other files; here they are faults.
    """
    scenes = dataset.scenes(split) if sequences is None else sequences
    if not scenes:
        raise InputError(
            f"{dataset.root}: expected scenes of the {split} split, found none in {dataset.version}; give the data of "
            "that split, or name another one with --split"
        )
    points = {r.prediction: _points(r, files.NUSCENES_COLUMNS) for r in dataset.records(scenes)}
    splits = sorted({name.split("/")[1] for name in points})
    if len(splits) != 1:
        raise InputError(
            f"{dataset.root}: expected scenes of one split, found {', '.join(splits)}; name those of one"
        )
    return Rules(
        taxonomy=dataset.taxonomy,
        what=_what(split, sequences),
        points=points,
        required=points.keys(),
        dtype=np.uint8,
        unlabelled=False,
        folders=("lidarseg/", f"lidarseg/{splits[0]}/", f"{splits[0]}/"),
        needs_folders=False,
        meta=f"{splits[0]}/submission.json",
    )


RULES: Mapping[type, Callable[..., Rules]] = {SemanticKitti: _semantickitti, NuScenes: _nuscenes}


def check_sources(data: bytes, shown: str) -> None:
    """Check a submission.json; `shown` is what the message begins with.

    Raises:
        InputError: where it is no JSON, or its "meta" has not just the five flags.
    """
    try:
        found = json.loads(data.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{shown}: expected JSON, found {reason}; write it again") from None
    meta = found.get("meta") if isinstance(found, dict) else None
    wanted = asdict(Sources())
    if not isinstance(meta, dict) or set(meta) != set(wanted):
        keys = (
            "no such object"
            if not isinstance(meta, dict)
            else ", ".join(map(repr, meta)) or "nothing"
        )
        raise InputError(
            f'{shown}: expected {", ".join(wanted)} in the object "meta", found {keys[:200]}; write these five'
        )
    if wrong := [key for key in wanted if not isinstance(meta[key], bool)]:
        kind = type(meta[wrong[0]]).__name__
        raise InputError(
            f"{shown}: expected true or false for {wrong[0]}, found a value of type {kind}; write a flag"
        )


def _points(record: ScanRecord, columns: int) -> int | None:
    path = record.points_path
    return files.count_rows(path, np.float32, columns) if path.is_file() else None


def _what(split: str, sequences: Sequence[str] | None) -> str:
    return f"the {split} split" if sequences is None else ", ".join(sorted(set(sequences)))
