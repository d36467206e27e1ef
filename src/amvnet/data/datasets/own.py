"""Labelled scans of a user in any layout, as a YAML file describes them (docs/own_data.md)."""

from __future__ import annotations

import dataclasses
import glob
from collections.abc import Sequence
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path

import numpy as np

from amvnet.data.datasets.base import Dataset, Split
from amvnet.data.datasets.description import SPLITS, WILDCARDS, Description, below, read_description
from amvnet.data.formats.detect import scan_stem
from amvnet.data.formats.find import ANY_FOLDERS, list_scans, matching
from amvnet.data.labels.readers import read_raw_labels
from amvnet.data.poses import Poses, read_poses, times_of
from amvnet.data.recordings import Normalise, Recording, ScanFile, by_recording
from amvnet.data.taxonomy import Taxonomy, check_classes
from amvnet.errors import InputError, counted, did_you_mean, readable, reason_of, shown
from amvnet.scan import Scan

SCANS_PER_VAL = 10  # of so many scans with labels, the last one validates by default


class OwnScans(Dataset):
    """A user's labelled scans. `Dataset` documents the arguments and errors of its methods.

    A scan's sequence is the first folder below the part of the pattern that has no wildcards. If
    the split cuts through a folder, its parts are sequences: `site-train`, `site-val`. A single
    sequence with labels is cut even without a split.
    """

    def __init__(
        self,
        description: Description,
        normalise: Normalise | None = None,
        scans: dict[str, ScanFile] | None = None,
    ) -> None:
        super().__init__(description.root, description.taxonomy, str(description.path))
        self.description = description
        self.described_sensor = description.sensor
        self.reading = f"{description.sensor}, {description.layout}"
        self.normalise = normalise
        if scans is not None:
            self._scans = scans
        self._counts: dict[str, int] = {}  # points of the scans that have been read, by name

    def parts(self) -> dict[str, tuple[str, ...]]:
        """Return the sequences of "train", "val", "test", "rest" (in none of these) and "all"."""
        parts: dict[str, set[str]] = {name: set() for name in (*SPLITS, "all")}
        for record, part in self._listing:
            for name in (part or "rest", "all"):
                parts.setdefault(name, set()).add(record.sequence)
        return {name: tuple(sorted(sequences)) for name, sequences in parts.items()}

    def split(self) -> Split:
        """Return how the file splits the sequences, or how the only sequence with labels is cut."""
        val = self._val_by_default
        note = f"no split: {counted(len(val), 'scan')} from {val[0]} on validate" if val else ""
        is_given = bool(self.description.split)
        return dataclasses.replace(super().split(), is_given=is_given, note=note)

    def lacks(self, split: str) -> str:
        """Return a message that says which splits the file has, if any."""
        found = f"only {' and '.join(self.description.split)}"
        if not self.description.split:
            labelled = {record.sequence for record, _ in self._listing if record.has_labels}
            alone = f", and labels of {min(labelled)} alone" if len(labelled) == 1 else ""
            found = f"no split{alone}"
        return (
            f"{self.spec}: expected scans of the split {split}, found {found}; name them under "
            f"split, such as {split}: [{self._listing[-1][0].name}], or name sequences to use"
        )

    def records(self, sequences: Sequence[str]) -> list[ScanFile]:
        """Return the scans of these sequences, in order; a folder's name stands for its parts."""
        present = self.parts()["all"]
        folders = {self._folder_of(name) for name in self._scans}
        for name in sequences:
            if name not in present and name not in folders:
                raise InputError(
                    f"{self.spec}: expected a sequence of {', '.join(present[:20])}, "
                    f"found {name!r}; name one of them"
                )

        chosen = [
            record
            for record, _ in self._listing
            if record.sequence in sequences or self._folder_of(record.name) in sequences
        ]
        # The scans of a recording stay in order, even if the split cuts it into sequences.
        return sorted(chosen, key=lambda record: (self._folder_of(record.name), record.name))

    def labelled(self, records: Sequence[ScanFile]) -> list[ScanFile]:
        """Return the scans that have labels."""
        labelled = [record for record in records if record.labels_path is not None]
        if labelled or not records:
            return labelled

        if self.description.unread is not None:  # labels of other classes
            check_classes(self.spec, self.description.unread, self.taxonomy)
        found = "no labels in the description"
        if self.description.labels is not None:
            found = f"no {self._label_file(records[0].name)}"
            if len(records) > 1:
                found += f", and none for the other {len(records) - 1} scans"
        raise InputError(
            f"{self.spec}: expected labelled scans, found {found}; "
            "correct labels in the file, or name other sequences"
        )

    def read(self, record: ScanFile, labels: bool = True) -> Scan:
        """Read one scan."""
        scan = record.recording.scan(record)
        self._counts[record.name] = len(scan)
        ids = self.labels(record, len(scan)) if labels else None
        return dataclasses.replace(scan, labels=ids, name=record.name, file_xyz=None)

    def read_unchanged(self, record: ScanFile) -> Scan:
        """Read the points of one scan as they are in its file."""
        scan = record.read().to_scan()
        self._counts[record.name] = len(scan)
        return dataclasses.replace(scan, name=record.name)

    def raw_labels(self, record: ScanFile, count: int) -> np.ndarray:
        """Read the (N,) raw ids of one scan."""
        place = self.description.labels
        assert place is not None
        assert record.labels_path is not None
        layout = self.description.layout
        missing = self.taxonomy.train_to_raw[0]
        return read_raw_labels(record.labels_path, count, place.field, layout, missing=missing)

    def poses(self, records: Sequence[ScanFile]) -> Poses | None:
        """Return the poses of the LiDAR in some scans, if the description names a file of poses.

        Each folder of scans has such a file, with a pose for each of its scans in their order. If
        it has times and another number of poses, the names of the scans are their times.
        """
        if not self.description.poses:
            return None

        file_of = {name: self._poses_file(scan) for name, scan in self._scans.items()}
        poses: dict[str, Poses] = {}
        for path in dict.fromkeys(file_of[record.name] for record in records):
            names = [name for name in file_of if file_of[name] == path]
            times = times_of(Path(name).name for name in names)
            poses |= zip(names, read_poses(path).at(times, len(names)), strict=True)
        return np.array([poses[record.name] for record in records])

    def _poses_file(self, scan: ScanFile) -> Path:
        """Return the file with the poses of the scans in the folder of a scan."""
        return below(scan.path.parent, self.description.poses)

    def count_points(self, record: ScanFile) -> int:
        """Return the number of points of a scan; the file is not read a second time."""
        if record.name not in self._counts:
            self._counts[record.name] = len(record.read().xyz)
        return self._counts[record.name]

    def recordings(self) -> list[Recording]:
        """Return the recordings: the files of one folder and one ending."""
        return list(by_recording(record for record, _ in self._listing))

    def normalised_by(self, normalise: Normalise) -> OwnScans:
        """Return the same scans, normalised."""
        recordings = {recording: normalise(recording) for recording in self.recordings()}
        scans = {}
        for name, scan in self._scans.items():
            scans[name] = dataclasses.replace(scan, recording=recordings[scan.recording])
        return OwnScans(self.description, normalise, scans)

    def with_classes(self, taxonomy: Taxonomy) -> OwnScans:
        """Return the same scans with other classes for predictions; labels are not read."""
        description = dataclasses.replace(
            self.description, taxonomy=taxonomy, unread=self.description.unread or self.taxonomy
        )
        return OwnScans(description, self.normalise, self._scans)

    def place_of_labels(self, record: ScanFile) -> Path:
        """Return the file that holds the labels of a scan, or its prediction if none may."""
        place = self.description.labels
        if place is None or place.field is not None:  # labels in a column cannot be replaced alone
            return self.root / record.prediction
        return self._label_file(record.name)

    def _label_file(self, name: str) -> Path:
        """Return the file that should hold the labels of a scan; the description has `labels`."""
        scan = self._scans[name]
        assert self.description.labels is not None
        return self.description.labels.path_of(scan.path, scan.name)

    def files_of(self, record: ScanFile) -> list[Path]:
        """Return the files of a scan, with its poses, and its labels even if they are not read."""
        files = super().files_of(record)
        if self.description.labels is not None:
            files.append(self._label_file(record.name))
        if self.description.poses:
            files.append(self._poses_file(record))
        return files

    @cached_property
    def _scans(self) -> dict[str, ScanFile]:
        """The scans in their files, by name: the path from `root`, without the ending."""
        scans: dict[str, ScanFile] = {}
        folders: dict[str, Recording] = {}
        for path in self._scan_paths():
            for scan in list_scans(path, layout=self.description.layout, folders=folders):
                name = (scan.path.parent.relative_to(self.root) / scan.name).as_posix()
                if name in scans:
                    raise InputError(
                        f"{self.spec}: expected one scan named {name}, found "
                        f"{scans[name].path.name} and {scan.path.name}; make the pattern of the "
                        "scans narrower"
                    )
                scans[name] = scan
                folder = Path(name).parent.relative_to(self._fixed)
                scan.recording.name = (
                    folder.as_posix() if folder.name else self._fixed.name or "all"
                )

        if not scans:
            raise InputError(
                f"{self.root}: expected scan files {self.description.scans}, found none; correct "
                "scans or root"
            )
        return scans

    def _scan_paths(self) -> list[Path]:
        """Return the files that match the pattern of the scans and hold no labels, sorted."""
        pattern = self.description.scans
        try:
            if ANY_FOLDERS in Path(pattern).parts:  # Python's own ** does not follow links
                matches = matching(Path(glob.escape(str(self.root))) / pattern)
            else:
                matches = sorted(self.root.glob(pattern))
        except (ValueError, NotImplementedError, IndexError, OSError) as error:
            # Python says nothing that helps of the pattern ".", an IndexError.
            reason = "" if isinstance(error, IndexError) else f" ({reason_of(error)[:160]})"
            raise InputError(
                f"{self.spec}: scans: expected a pattern, found {shown(pattern)}{reason}; "
                "correct it, or root"
            ) from None
        paths = [path for path in matches if path.is_file() and not path.name.startswith(".")]

        place = self.description.labels
        if place is None or place.file is None:
            return paths
        label_paths = {place.path_of(path, scan_stem(path)) for path in paths}
        return [path for path in paths if path not in label_paths]

    @cached_property
    def _listing(self) -> list[tuple[ScanFile, str]]:
        """All scans as the dataset returns them, each with its split ("" if it is in none)."""
        splits = self._splits()
        splits_of_folder: dict[str, set[str]] = {}
        for name, split in splits.items():
            splits_of_folder.setdefault(self._folder_of(name), set()).add(split)

        listing = []
        for name, scan in self._scans.items():
            sequence = self._folder_of(name)
            if len(splits_of_folder[sequence]) > 1:
                sequence = f"{sequence}-{splits[name] or 'rest'}"

            record = dataclasses.replace(
                scan,
                name=name,
                sequence=sequence,
                labels_path=self._labels.get(name) if self.description.unread is None else None,
                prediction=f"{name}.label",
                dataset=self,
            )
            listing.append((record, splits[name]))
        return listing

    @cached_property
    def _labels(self) -> dict[str, Path]:
        """The label files that exist, by the name of the scan."""
        place = self.description.labels
        paths = {}
        for name in self._scans:
            if place is not None:
                path = self._label_file(name)
                with readable(f"{self.spec}: labels: {shown(str(path))}"):
                    if path.is_file():
                        paths[name] = path
        return paths

    @cached_property
    def _val_by_default(self) -> list[str]:
        """The names of the scans that validate if there is no split and one sequence has labels.

        These are the last tenth of its scans with labels, and the scans among and after them.
        """
        folders = {self._folder_of(name) for name in self._labels}
        labelled = list(self._labels)
        if self.description.split or len(folders) != 1 or len(labelled) < 2:
            return []
        first = labelled[-max(len(labelled) // SCANS_PER_VAL, 1)]
        names = [name for name in self._scans if self._folder_of(name) in folders]
        return names[names.index(first) :]

    @cached_property
    def _fixed(self) -> Path:
        """The folders at the beginning of the pattern of the scans that have no wildcards."""
        fixed = Path()
        for part in Path(self.description.scans).parts[:-1]:
            if set(part) & WILDCARDS:
                break
            fixed /= part
        return fixed

    def _folder_of(self, name: str) -> str:
        """Return the name of the folder that is the sequence of a scan."""
        parts = Path(name).relative_to(self._fixed).parts
        return parts[0] if len(parts) > 1 else self._fixed.name or "all"

    def _splits(self) -> dict[str, str]:
        """Return the split of each scan by the scan's name; "" if it is in none.

        If the file has a split without "train", the scans that it does not name are in "train".
        """
        val = self._val_by_default
        if val:
            folder = self._folder_of(val[0])
            train = [name for name in self._scans if self._folder_of(name) == folder]
            in_none = dict.fromkeys(self._scans, "")
            return in_none | dict.fromkeys(train, "train") | dict.fromkeys(val, "val")

        entries = []
        for split, names in self.description.split.items():
            entries += [(split, entry) for entry in names]
        leaves_out_train = self.description.split and "train" not in self.description.split
        split_of_rest = "train" if leaves_out_train else ""

        splits = {}
        matched = set()
        for name, scan in self._scans.items():
            found = self._entries_of(name, scan.path, entries)
            of_scan = sorted({split for split, _ in found}, key=SPLITS.index)
            if len(of_scan) > 1:
                raise InputError(
                    f"{self.spec}: expected a scan in one split, found {name} in "
                    f"{' and '.join(of_scan)}; correct the split"
                )
            splits[name] = of_scan[0] if of_scan else split_of_rest
            matched |= found

        for split, entry in entries:
            if (split, entry) not in matched:
                folders = dict.fromkeys(map(self._folder_of, self._scans))
                advice = (
                    f"name a folder ({', '.join(list(folders)[:20])}), or a scan or a pattern with "
                    f"all its folders, such as {next(iter(self._scans))}"
                )
                raise InputError(
                    f"{self.spec}: split: {split}: expected entries that match scans, found "
                    f"{shown(entry)}, which matches none" + did_you_mean(entry, folders, advice)
                )
        return splits

    def _entries_of(
        self, name: str, path: Path, entries: Sequence[tuple[str, str]]
    ) -> set[tuple[str, str]]:
        """Return the entries of the split, each with its split, that match a scan."""
        folders = map(Path.as_posix, Path(name).parents)
        file = path.relative_to(self.root).as_posix()
        names = {name, file, self._folder_of(name), *folders}

        found = set()
        for split, entry in entries:
            if entry in names or (
                set(entry) & WILDCARDS and (fnmatchcase(name, entry) or fnmatchcase(file, entry))
            ):
                found.add((split, entry))
        return found


def open_own(path: Path | str) -> OwnScans:
    """Open the dataset that a YAML file describes.

    Raises:
        InputError: as `read_description`, or if there is no scan, two scans have one name, or the
            split does not fit the scans.
    """
    dataset = OwnScans(read_description(path))
    dataset.parts()  # raises now what is wrong with the scans and the split
    return dataset
