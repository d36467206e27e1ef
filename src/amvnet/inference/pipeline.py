"""Segment many scans: read, compute and write at the same time, with few scans in memory."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from amvnet.data.formats.registry import COLUMN_READERS
from amvnet.data.labels.writers import (
    SCORES,
    SIGNATURES,
    UNCERTAIN,
    check_kind,
    write_uncertain,
)
from amvnet.data.recordings import ScanFile, by_recording
from amvnet.data.taxonomy import Taxonomy
from amvnet.errors import InputError, SomeBroken, counted, memory_for
from amvnet.files import (
    Signature,
    alone_in,
    atomic_write,
    check_not_read,
    check_outputs,
    digest,
    inside,
    size_and_time,
)
from amvnet.inference.drive import Broken, Drives, Labelled, Outcome
from amvnet.inference.journal import UNFINISHED, Entry, Journal, check_unchanged, read_journals
from amvnet.inference.scan_stream import READ_AHEAD, stream_groups
from amvnet.inference.segmentation import Segmentation
from amvnet.progress import Progress, no_progress
from amvnet.scan import Scan
from amvnet.sensors.measure import MEASURED_SCANS

UNCERTAIN_ENDING = ".uncertain.npy"


@dataclass(frozen=True)
class LabelFiles:
    """The files that are written for each scan.

    Attributes:
        kind: the format of the labels of scan files, one of `writers.KINDS`; datasets have their
            own format.
        scores: also write both networks' probabilities, float16 (N, K), as `rv` and `bev` in an
            `.npz`.
        uncertain: also write which points are uncertain, (N,) bool, as `.uncertain.npy`.

    Raises:
        InputError: if the format is unknown.
    """

    kind: str = "label"
    scores: bool = False
    uncertain: bool = False

    def __post_init__(self) -> None:
        check_kind(self.kind)

    @property
    def endings(self) -> tuple[str, ...]:
        """The endings of the files of a scan file; the label file is first."""
        scores = (".npz",) if self.scores else ()
        uncertain = (UNCERTAIN_ENDING,) if self.uncertain else ()
        return (f".{self.kind}", *scores, *uncertain)

    def of(self, scan: ScanFile) -> dict[Path, Signature]:
        """Return the files of a scan, by the path relative to the folder of the labels."""
        labels = scan.dataset.place_of_prediction(scan, self.kind)
        ending = labels.suffix or f".{self.kind}"  # a name such as ".label" has no suffix
        files = {labels: SIGNATURES[ending]}
        if self.scores:
            files[scan.scores_path] = SCORES
        if self.uncertain:
            files[scan.scores_path.with_suffix(UNCERTAIN_ENDING)] = UNCERTAIN
        return files


LABELS = LabelFiles()


@dataclass(frozen=True)
class OutputOptions:
    """Where the files of the scans are written, and what they replace.

    Attributes:
        files: which files are written.
        taxonomy: the classes of the labels; by default the classes of the dataset.
        resume: leave out the scans that an earlier run into the same folder has done.
        also_read: other files that the command reads, which must not be replaced; what names no
            file is ignored.
    """

    folder: Path
    files: LabelFiles = LABELS
    taxonomy: Taxonomy | None = None
    overwrite: bool = False
    resume: bool = False
    also_read: Sequence[Path | str | None] = ()


# A function that segments scans in memory, given the inputs that they were read from. It raises
# InputError if a scan is broken.
Segment = Callable[[Sequence[ScanFile], Sequence[Scan]], list[Segmentation]]
Written = TypeVar("Written")


@dataclass(frozen=True)
class Pipeline:
    """Reads, segments and writes scans at the same time, into files that `check_output` allows.

    Attributes:
        batch: the number of scans that go through the networks together; it changes labels only by
            rounding.
        at_once: the number of batches that are segmented at the same time, each with its share of
            the threads.
    """

    scans: Sequence[ScanFile]
    segment: Segment
    output: OutputOptions
    batch: int = 1
    at_once: int = 1
    drives: Drives | None = None

    def run(
        self, settings: Mapping[str, Any], progress: Progress = no_progress
    ) -> tuple[list[Entry], list[str]]:
        """Segment the scans, and write the results.

        Args:
            settings: all that the labels depend on, in JSON types; an earlier run is resumed only
                with the same settings.

        Returns:
            The entries of the scans that are done, including scans of the run that is resumed; and
            a line for each scan that is broken.

        Raises:
            InputError: if the run that is resumed had other settings or another scan of the same
                name, another run is writing into the folder, or `check_output` raises it.
        """
        folder = self.output.folder
        with alone_in(folder):
            check_output(self.scans, self.output, settings)  # another run may have ended meanwhile
            kept = self._kept(settings)
            remaining = {scan for scan in self.scans if _key(scan) not in kept}

            faults: list[str] = []
            with Journal(folder, settings, kept.values()) as journal:
                for written in self._label(remaining, progress):
                    if isinstance(written, Entry):
                        journal.add(written)
                    else:
                        faults.append(written)
                entries = journal.close()
            return [entries[_key(scan)] for scan in self.scans if _key(scan) in entries], faults

    def _label(self, remaining: Set[ScanFile], progress: Progress) -> Iterator[Entry | str]:
        """Label some of the scans; yield the entry of each, or why it is broken."""
        segmented = [scan for scan in self.scans if scan in remaining]
        if self.drives is not None:  # labels also depend on the scans around
            segmented = self.drives.in_reach(self.scans, remaining)

        def write(outcome: Outcome) -> Entry | str | None:
            return self.write_or_explain(outcome) if outcome.scan in remaining else None

        for written in self.stream(segmented, write, progress=progress):
            if written is not None:
                yield written

    def _kept(self, settings: Mapping[str, Any]) -> dict[str, Entry]:
        """Return the entries of an earlier run with equal settings that stay in the journal.

        The entries of other scans stay, so that a run over all scans can be resumed later. If the
        run is resumed, scans that are still done stay too, and need not be segmented again.
        """
        earlier = read_journals(self.output.folder)
        changed = earlier.changed(settings)
        if self.output.resume:
            advice = "start over with --overwrite instead of --resume"
            check_unchanged(self.output.folder, changed, advice)
        if changed:
            return {}

        kept = dict(earlier.entries)
        for scan in self.scans:
            entry = kept.get(_key(scan))
            if entry is not None and not (self.output.resume and self._is_done(scan, entry)):
                del kept[entry.scan]
        return kept

    def _is_done(self, scan: ScanFile, entry: Entry) -> bool:
        """Return whether the files of a scan of an earlier run exist and are still right.

        The scan has not changed, nor have the first scans of its recording and what a description
        says of them, which decide how it is normalised.

        Raises:
            InputError: if the files are those of another scan of this name.
        """
        is_same = entry.origin == self._origins[entry.scan]
        if not is_same and entry.place not in ("", str(scan.path.resolve())):
            raise InputError(
                f"{scan.path}: expected no labels of another scan of this name in "
                f"{self.output.folder}, found those of {entry.place}; write to another folder, or "
                "say --overwrite instead of --resume"
            )
        paths = [self.output.folder / path for path in self.output.files.of(scan)]
        return is_same and all(map(Path.is_file, paths))

    @cached_property
    def _origins(self) -> dict[str, str]:
        """The digests for `Entry.origin`, by scan."""
        origins = {}
        stamps = {path: size_and_time(path) for path in {scan.path for scan in self.scans}}
        for scans in by_recording(self.scans).values():
            files = [(scan.name, *stamps[scan.path]) for scan in scans]
            for index, scan in enumerate(scans):
                values: list[Any] = [files[index][1:], files[:MEASURED_SCANS]]
                if scan.dataset.reading:
                    values.append(scan.dataset.reading)
                if self.drives is not None:  # the labels also depend on the scans in reach
                    values.append(files[self.drives.reach_of(index)])
                origins[_key(scan)] = digest(json.dumps(values))
        return origins

    def stream(
        self,
        scans: Sequence[ScanFile],
        write: Callable[[Outcome], Written],
        writers: int = 1,
        progress: Progress = no_progress,
    ) -> Iterator[Written]:
        """Read, segment and write scans; only a few are in memory at a time.

        Args:
            write: takes the outcomes in order. `writers` other threads call it.
            progress: called as scans are segmented; a drive's scans are written much later.

        Yields:
            The values that `write` returns.
        """
        groups = stream_groups(
            scans,
            load=lambda scan: scan.load(),
            compute=self._segment_group,
            batch=self.batch,
            at_once=self.at_once,
        )
        writing = deque[Future[Written]]()
        # Reading, computing and writing go on at the same time, each on other scans.
        with closing(groups), ThreadPoolExecutor(writers) as pool:
            outcomes = _counted(chain.from_iterable(groups), len(scans), progress)
            if self.drives is not None:
                outcomes = self.drives.fuse(outcomes)
            for outcome in outcomes:
                writing.append(pool.submit(write, outcome))
                # Yield what is written without delay, so that it gets into the journal.
                while writing and (len(writing) > READ_AHEAD or writing[0].done()):
                    yield writing.popleft().result()
            while writing:
                yield writing.popleft().result()

    def _segment_group(self, group: Sequence[tuple[ScanFile, Future[Scan]]]) -> list[Outcome]:
        """Wait for scans that are being read, and segment them together, in their order."""
        outcomes: dict[ScanFile, Outcome] = {}
        loaded: list[tuple[ScanFile, Scan]] = []
        for scan, load in group:
            try:
                with memory_for(scan.name):
                    loaded.append((scan, load.result()))
            except InputError as error:
                outcomes[scan] = Broken(scan, error)
        for outcome in self._segment_loaded(loaded):
            outcomes[outcome.scan] = outcome
        return [outcomes[scan] for scan, _ in group]

    def _segment_loaded(self, loaded: Sequence[tuple[ScanFile, Scan]]) -> list[Outcome]:
        """Segment scans together; if that fails, segment them one by one to find broken ones."""
        if not loaded:
            return []
        scans, points = zip(*loaded, strict=True)
        try:
            with memory_for(scans[0].name):
                results = self.segment(scans, points)
            return list(map(Labelled, scans, points, results))
        except InputError as error:
            if len(loaded) == 1:
                return [Broken(scans[0], error)]
        return list(chain.from_iterable(self._segment_loaded([pair]) for pair in loaded))

    def write_or_explain(self, outcome: Outcome) -> Entry | str:
        """Write the files of a scan; return its entry, or a line that says why it is broken."""
        return str(outcome.error) if isinstance(outcome, Broken) else self.write(outcome)

    def write(self, labelled: Labelled) -> Entry:
        """Write the files of a scan, the labels last: if they exist, the other files exist."""
        scan, loaded, result = labelled.scan, labelled.loaded, labelled.result
        output = self.output
        scores_path = inside(output.folder, scan.scores_path)
        if output.files.scores:
            write_scores(scores_path, result)
        if output.files.uncertain:
            write_uncertain(scores_path.with_suffix(UNCERTAIN_ENDING), result.uncertain)

        scan.dataset.write_labels(
            scan,
            output.folder,
            loaded,
            result.labels,
            taxonomy=output.taxonomy,
            kind=output.files.kind,
            uncertain=result.uncertain if result.has_two_networks else None,
        )

        own = np.zeros(len(result), bool) if loaded.own is None else loaded.own
        points = int(np.count_nonzero(loaded.valid))
        return Entry(
            scan=_key(scan),
            origin=self._origins[_key(scan)],
            sensor=scan.recording.name,
            points=points,
            uncertain=round(result.doubt * points),
            counts=np.bincount(result.labels[~own]).tolist(),
            own=int(np.count_nonzero(own)),
            place=str(scan.path.resolve()),
        )


def _counted(outcomes: Iterable[Outcome], total: int, progress: Progress) -> Iterator[Outcome]:
    """Yield outcomes, and report how many there were."""
    progress(0, total)
    for count, outcome in enumerate(outcomes, start=1):
        progress(count, total)
        yield outcome


def check_faults(faults: Sequence[str], total: int) -> None:
    """Raise SomeBroken if some of `total` scans are broken, InputError if all are broken."""
    if faults and len(faults) == total:
        others = len(faults) - 1
        more = f" (and {counted(others, 'other scan')} that cannot be used)" if others else ""
        raise InputError(faults[0] + more)
    if faults:
        raise SomeBroken(
            f"{total - len(faults)} of {total} scans are labelled, {len(faults)} cannot be used",
            list(faults),
        )


def check_output(
    scans: Sequence[ScanFile], output: OutputOptions, settings: Mapping[str, Any] | None = None
) -> None:
    """Check that the files of some scans may be written; call this before any long work.

    The files of the run that is resumed may be replaced. The labels of other scans, of an earlier
    run that has ended, stay beside the new ones if both runs have the same settings.

    Args:
        settings: as `Pipeline.run` takes them; None if they are unknown.

    Raises:
        InputError: if two scans would have the same files, a scan and its output would have the
            same folder, a file may not be written, or the folder has other scans' labels of an
            earlier run with other settings, which is neither resumed nor overwritten.
    """
    folder = output.folder
    run = read_journals(folder)
    earlier = run.entries
    _check_names(scans)
    others = earlier.keys() - {_key(scan) for scan in scans}
    is_unlike = settings is None or run.changed(settings) or (folder / UNFINISHED).exists()
    if others and is_unlike and not (output.resume or output.overwrite):
        raise InputError(
            f"{folder}: expected a new folder, found the labels of {counted(len(others), 'scan')} "
            "of an earlier run that is unfinished or has other settings; write to another folder, "
            "or say --resume to go on with that run, or --overwrite to keep its labels beside the "
            "new ones"
        )
    inputs = list(output.also_read)
    own_files: list[Path] = []
    new_files: dict[Path, Signature] = {}
    for scan in scans:
        inputs += scan.files
        for path, signature in output.files.of(scan).items():
            if output.resume and _key(scan) in earlier:
                own_files.append(inside(folder, path))
            else:
                new_files[inside(folder, path)] = signature
        _check_folder(scan, output)

    check_not_read(own_files, inputs)
    # The journal of a run that was killed lacks the files that it wrote last.
    is_killed = output.resume and (folder / UNFINISHED).exists()
    check_outputs(new_files, inputs, output.overwrite or is_killed)


def _check_names(scans: Sequence[ScanFile]) -> None:
    """Raise InputError if two scans would have the same files."""
    named: dict[Path, ScanFile] = {}
    for scan in scans:
        other = named.setdefault(scan.scores_path, scan)
        if other is not scan:
            raise InputError(
                f"expected scans of different names, found {scan.scores_path.stem} in {other.path} "
                f"and in {scan.path}; segment them in two runs with two folders"
            )


def _check_folder(scan: ScanFile, output: OutputOptions) -> None:
    """Raise InputError if output files would lie among the scans and look like scans."""
    labels_look_like_scans = f".{output.files.kind}" in COLUMN_READERS
    scores_look_like_scans = output.files.scores and scan.path.suffix.lower() == ".npz"
    folder = (output.folder / scan.scores_path).parent
    is_own_folder = folder.resolve() == scan.path.parent.resolve()
    if is_own_folder and (labels_look_like_scans or scores_look_like_scans):
        raise InputError(
            f"{scan.path}: expected another folder for the labels, found the scan's own folder; "
            "change --out"
        )


def _key(scan: ScanFile) -> str:
    return str(scan.scores_path)


def write_scores(path: Path, result: Segmentation) -> None:
    """Write both networks' probabilities, (N, K) float16, as `rv` and `bev` in an `.npz`."""
    arrays: dict[str, Any] = {}
    if result.rv is not None:
        arrays["rv"] = result.rv.astype(np.float16)
    if result.bev is not None:
        arrays["bev"] = result.bev.astype(np.float16)
    with atomic_write(path) as part:
        np.savez_compressed(part, **arrays)
