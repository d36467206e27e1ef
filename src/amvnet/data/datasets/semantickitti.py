"""SemanticKITTI in its official layout: sequences/XX/velodyne, labels and predictions."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from amvnet.data.datasets.base import Dataset, not_trained_on
from amvnet.data.formats.cloud import check_usable
from amvnet.data.formats.raw import KITTI_COLUMNS, count_rows, read_table
from amvnet.data.labels.ids import check_bits, read_ids
from amvnet.data.poses import Poses, read_poses
from amvnet.data.recordings import Recording, ScanFile
from amvnet.data.taxonomy import SEMANTICKITTI
from amvnet.errors import InputError
from amvnet.scan import Scan


class SemanticKitti(Dataset):
    """A SemanticKITTI dataset in a folder that holds `sequences/`, or in `sequences` itself.

    `Dataset` documents the arguments and errors of its methods.

    Raises:
        InputError: if `root` does not have this layout.
    """

    def __init__(self, root: Path | str) -> None:
        super().__init__(root, SEMANTICKITTI)
        if not self._sequences_on_disk():
            raise InputError(
                f"{self.root}: expected sequences/XX/velodyne/*.bin, found no folder XX/velodyne; "
                "give the folder that holds `sequences`"
            )

    @staticmethod
    def matches(root: Path) -> bool:
        """Return whether a folder has this layout."""
        return any(root.glob("sequences/*/velodyne")) or any(root.glob("*/velodyne"))

    @staticmethod
    def holds(root: Path, folder: Path) -> bool:
        """Return whether a folder below `root` is part of a dataset in `root`."""
        first, *rest = folder.relative_to(root).parts
        if first == "sequences":
            return any(root.glob("sequences/*/velodyne"))
        # `root` may be the folder of the sequences.
        return (root / first / "velodyne").is_dir() and rest in ([], ["velodyne"], ["labels"])

    def parts(self) -> dict[str, tuple[str, ...]]:
        """Return the sequences of "train", "val", "test" and "all" that are on disk."""
        present = self._sequences_on_disk()
        splits = {}
        for split, names in self.taxonomy.splits.items():
            splits[split] = tuple(name for name in names if name in present)
        return {**splits, "all": present}

    def lacks(self, split: str) -> str:
        """Return the message that names the sequences of a split, and those on disk."""
        present = self._sequences_on_disk()
        unseen = [name for name in present if name not in self.taxonomy.splits["train"]]
        return (
            f"{self.root}: expected a sequence of the {split} split "
            f"({', '.join(self.taxonomy.splits.get(split, ()))}), found {', '.join(present)}; "
            f"add one, or name {not_trained_on(unseen)}"
        )

    def records(self, sequences: Sequence[str]) -> list[ScanFile]:
        """Return the scans of these sequences, in order."""
        records: list[ScanFile] = []
        for sequence in sorted(set(sequences)):
            records += self._records(sequence)
        return records

    def read(self, record: ScanFile, labels: bool = True) -> Scan:
        """Read one scan."""
        path = record.path
        points = check_usable(read_table(path, np.float32, KITTI_COLUMNS), path)
        ids = self.labels(record, len(points)) if labels else None
        return Scan(points, labels=ids, name=record.name)

    def raw_labels(self, record: ScanFile, count: int) -> np.ndarray:
        """Read the (N,) raw ids of one scan."""
        assert record.labels_path is not None
        return check_bits(record.labels_path, read_ids(record.labels_path, np.uint32, count))

    def poses(self, records: Sequence[ScanFile]) -> Poses | None:
        """Return the poses of the LiDAR, from poses.txt and calib.txt of the sequence."""
        path = self._folder / records[0].sequence / "poses.txt"
        if not path.is_file():
            return None
        # The line of a pose is the number of its scan.
        return read_poses(path).numbered([record.path.stem for record in records])

    def count_points(self, record: ScanFile) -> int:
        """Return the number of points of a scan, from the size of its file."""
        return count_rows(record.path, np.float32, KITTI_COLUMNS)

    @property
    def _folder(self) -> Path:
        inner = self.root / "sequences"
        return inner if inner.is_dir() else self.root

    def _sequences_on_disk(self) -> tuple[str, ...]:
        return tuple(sorted(path.parent.name for path in self._folder.glob("*/velodyne")))

    def _records(self, sequence: str) -> list[ScanFile]:
        folder = self._folder / sequence
        labelled = {path.name for path in (folder / "labels").glob("*.label")}

        recording = Recording(sequence)
        for path in sorted((folder / "velodyne").glob("*.bin")):
            # A program that was killed may have left an unfinished file, hidden by a leading dot.
            if path.name.startswith("."):
                continue

            labels_path = folder / "labels" / f"{path.stem}.label"
            record = ScanFile(
                name=f"{sequence}/{path.stem}",
                recording=recording,
                path=path,
                sequence=sequence,
                labels_path=labels_path if labels_path.name in labelled else None,
                prediction=f"sequences/{sequence}/predictions/{path.stem}.label",
                dataset=self,
            )
            recording.scans.append(record)

        if not recording.scans:
            raise InputError(
                f"{folder / 'velodyne'}: expected the scans *.bin of sequence {sequence}, "
                f"found none; name one of {', '.join(self._sequences_on_disk())}"
            )

        return recording.scans
