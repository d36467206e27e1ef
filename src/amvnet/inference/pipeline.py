"""Segment many scans: read, compute and write at the same time, with few scans in memory."""

from __future__ import annotations

import hashlib
import json
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from amvnet.data.formats.registry import COLUMN_READERS
from amvnet.data.labels.writers import SCORES, SIGNATURES, UNCERTAIN, write_uncertain
from amvnet.errors import InputError, SomeBroken, memory_for
from amvnet.files import alone_in, atomic_write, inside
from amvnet.inference.drive import Drives
from amvnet.inference.journal import UNFINISHED, Entry, Journal, check_unchanged, read_journals
from amvnet.inference.listing import InputScan, LoadedScan, Outcome
from amvnet.inference.scan_stream import READ_AHEAD, stream_groups
from amvnet.inference.segmentation import Segmentation
from amvnet.outputs import Signature, check_not_read, check_outputs
from amvnet.progress import Progress, counted, no_progress
from amvnet.scan import Scan
from amvnet.sensors.measure import MEASURED_SCANS

UNCERTAIN_ENDING = ".uncertain.npy"
DIGEST_LENGTH = 16  # the hexadecimal digits of a digest in the journal


@dataclass(frozen=True)
class OutputOptions:
    """The choice of files that are written for each scan.

    Attributes:
        kind: the format of the labels of scan files, one of `writers.KINDS`; datasets have their
            own format.
        scores: also write both networks' probabilities, float16 (N, K), as `rv` and `bev` in an
            `.npz`.
        uncertain: also write which points are uncertain, (N,) bool, as `.uncertain.npy`.
        resume: leave out the scans that an earlier run into the same folder has done.
        also_read: other files that the command reads, which must not be replaced; what names no
            file is ignored.
    """

    folder: Path
    kind: str = "label"
    scores: bool = False
    uncertain: bool = False
    overwrite: bool = False
    resume: bool = False
    also_read: Sequence[Path | str | None] = ()

    def files_of(self, scan: InputScan) -> dict[Path, Signature]:
        """Return the files that are written for a scan, by the path relative to the folder."""
        labels = scan.labels_path(self.kind)
        ending = labels.suffix or f".{self.kind}"  # a name such as ".label" has no suffix
        files = {labels: SIGNATURES[ending]}
        if self.scores:
            files[scan.scores_path] = SCORES
        if self.uncertain:
            files[scan.scores_path.with_suffix(UNCERTAIN_ENDING)] = UNCERTAIN
        return files


# A function that segments scans in memory, given the inputs that they were read from. It raises
# InputError if a scan is broken.
Segment = Callable[[Sequence[InputScan], Sequence[Scan]], list[Segmentation]]
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

    scans: Sequence[InputScan]
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
            InputError: if the run that is resumed had other settings, another run is writing into
                the folder, or `check_output` raises it.
        """
        folder = self.output.folder
        with alone_in(folder):
            check_output(self.scans, self.output)  # another run may have ended meanwhile
            earlier = read_journals(folder)
            changed = earlier.changed(settings)
            if self.output.resume:
                advice = "start over with --overwrite instead of --resume"
                check_unchanged(folder, changed, advice)
            kept = {} if changed else self._kept(earlier.entries)
            remaining = [scan for scan in self.scans if _key(scan) not in kept]

            # Scans around the remaining ones are segmented again, if labels depend on them.
            segmented = remaining
            if self.drives is not None:
                segmented = self.drives.in_reach(self.scans, remaining)
            new = {_key(scan) for scan in remaining}

            def write(outcome: Outcome) -> Entry | str | None:
                return self.write_or_explain(outcome) if _key(outcome[0]) in new else None

            faults: list[str] = []
            with Journal(folder, settings, kept.values()) as journal:
                for outcome in self.stream(segmented, write, progress=progress):
                    if outcome is None:
                        continue
                    if isinstance(outcome, Entry):
                        journal.add(outcome)
                    else:
                        faults.append(outcome)
                entries = journal.close()
            return [entries[_key(scan)] for scan in self.scans if _key(scan) in entries], faults

    def _kept(self, earlier: Mapping[str, Entry]) -> dict[str, Entry]:
        """Return the entries of an earlier run with equal settings that stay in the journal.

        The entries of other scans stay, so that a run over all scans can be resumed later. If the
        run is resumed, scans that are still done stay too, and need not be segmented again.
        """
        kept = dict(earlier)
        for scan in self.scans:
            entry = earlier.get(_key(scan))
            if entry is not None and not (self.output.resume and self._is_done(scan, entry)):
                del kept[entry.scan]
        return kept

    def _is_done(self, scan: InputScan, entry: Entry) -> bool:
        """Return whether the files of a scan of an earlier run exist and are still right.

        The scan has not changed, nor have the first scans of its recording, which decide how it is
        normalised.
        """
        paths = [self.output.folder / path for path in self.output.files_of(scan)]
        return entry.origin == self._origins[entry.scan] and all(map(Path.is_file, paths))

    @cached_property
    def _origins(self) -> dict[str, str]:
        """The digests for `Entry.origin`, by scan."""
        recordings: dict[str, list[InputScan]] = {}
        for scan in self.scans:
            recordings.setdefault(scan.source, []).append(scan)

        origins = {}
        for scans in recordings.values():
            files = [(scan.name, *_size_and_time(scan.path)) for scan in scans]
            for index, scan in enumerate(scans):
                values: list[Any] = [files[index][1:], files[:MEASURED_SCANS]]
                if self.drives is not None:  # the labels also depend on the scans in reach
                    values.append(files[self.drives.reach_of(index)])
                digest = hashlib.sha256(json.dumps(values).encode()).hexdigest()
                origins[_key(scan)] = digest[:DIGEST_LENGTH]
        return origins

    def stream(
        self,
        scans: Sequence[InputScan],
        write: Callable[[Outcome], Written],
        writers: int = 1,
        progress: Progress = no_progress,
    ) -> Iterator[Written]:
        """Read, segment and write scans; only a few are in memory at a time.

        Args:
            write: takes the outcomes in order, except that scans that cannot be read may come
                earlier. `writers` other threads call it.
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

    def _segment_group(
        self, group: Sequence[tuple[InputScan, Future[LoadedScan]]]
    ) -> list[Outcome]:
        """Wait for scans that are being read, and segment them together.

        Scans that cannot be read come first in the list.
        """
        outcomes: list[Outcome] = []
        loaded: list[tuple[InputScan, LoadedScan]] = []
        for scan, load in group:
            try:
                with memory_for(scan.name):
                    loaded.append((scan, load.result()))
            except InputError as error:
                outcomes.append((scan, None, error))
        return outcomes + self._segment_loaded(loaded)

    def _segment_loaded(self, loaded: Sequence[tuple[InputScan, LoadedScan]]) -> list[Outcome]:
        """Segment scans together; if that fails, segment them one by one to find broken ones."""
        if not loaded:
            return []
        try:
            with memory_for(loaded[0][0].name):
                results = self.segment(
                    [scan for scan, _ in loaded], [item.scan for _, item in loaded]
                )
            return [(*pair, result) for pair, result in zip(loaded, results, strict=True)]
        except InputError as error:
            if len(loaded) == 1:
                return [(loaded[0][0], None, error)]
        return list(chain.from_iterable(self._segment_loaded([pair]) for pair in loaded))

    def write_or_explain(self, outcome: Outcome) -> Entry | str:
        """Write the files of a scan; return its entry, or a line that says why it is broken."""
        scan, loaded, result = outcome
        if loaded is None or isinstance(result, InputError):
            return str(result)
        return self.write(scan, loaded, result)

    def write(self, scan: InputScan, loaded: LoadedScan, result: Segmentation) -> Entry:
        """Write the files of a scan, the labels last: if they exist, the other files exist."""
        folder = self.output.folder
        scores_path = inside(folder, scan.scores_path)
        if self.output.scores:
            write_scores(scores_path, result)
        if self.output.uncertain:
            write_uncertain(scores_path.with_suffix(UNCERTAIN_ENDING), result.uncertain)

        scan.write_labels(folder, loaded, result, self.output.kind)

        points = int(np.count_nonzero(loaded.scan.valid))
        uncertain = round(result.doubt * points)
        key = _key(scan)
        own = np.zeros(len(result), bool) if loaded.scan.own is None else loaded.scan.own
        counts = np.bincount(result.labels[~own]).tolist()
        values = key, self._origins[key], scan.source, points, uncertain, counts
        return Entry(*values, int(np.count_nonzero(own)))


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


def check_output(scans: Sequence[InputScan], output: OutputOptions) -> None:
    """Check that the files of some scans may be written; call this before any long work.

    The files of the run that is resumed may be replaced.

    Raises:
        InputError: if two scans would have the same files, a scan and its output would have the
            same folder, a file may not be written, or the folder has other scans' labels of an
            earlier run, which is neither resumed nor overwritten.
    """
    folder = output.folder
    earlier = read_journals(folder).entries
    _check_names(scans)
    others = earlier.keys() - {_key(scan) for scan in scans}
    if others and not (output.resume or output.overwrite):
        raise InputError(
            f"{folder}: expected a new folder, found the labels of {counted(len(others), 'scan')} "
            "of an earlier run; write to another folder, or say --resume to go on with that run, "
            "or --overwrite to keep its labels beside the new ones"
        )
    inputs = list(output.also_read)
    own_files: list[Path] = []
    new_files: dict[Path, Signature] = {}
    for scan in scans:
        inputs += scan.files
        for path, signature in output.files_of(scan).items():
            if output.resume and _key(scan) in earlier:
                own_files.append(inside(folder, path))
            else:
                new_files[inside(folder, path)] = signature
        _check_folder(scan, output)

    check_not_read(own_files, inputs)
    # The journal of a run that was killed lacks the files that it wrote last.
    is_killed = output.resume and (folder / UNFINISHED).exists()
    check_outputs(new_files, inputs, output.overwrite or is_killed)


def _check_names(scans: Sequence[InputScan]) -> None:
    """Raise InputError if two scans would have the same files."""
    paths: set[Path] = set()
    for scan in scans:
        if scan.scores_path in paths:
            raise InputError(
                f"expected scans of different names, found {scan.name} twice "
                f"({scan.scores_path.stem}); segment them in two runs with two folders"
            )
        paths.add(scan.scores_path)


def _check_folder(scan: InputScan, output: OutputOptions) -> None:
    """Raise InputError if output files would lie among the scans and look like scans."""
    labels_look_like_scans = f".{output.kind}" in COLUMN_READERS
    scores_look_like_scans = output.scores and scan.path.suffix.lower() == ".npz"
    folder = (output.folder / scan.scores_path).parent
    is_own_folder = folder.resolve() == scan.path.parent.resolve()
    if is_own_folder and (labels_look_like_scans or scores_look_like_scans):
        raise InputError(
            f"{scan.path}: expected another folder for the labels, found the scan's own folder; "
            "change --out"
        )


def _size_and_time(path: Path) -> tuple[int, int]:
    """Return a file's size in bytes and time of change in nanoseconds; zeros if it is missing."""
    try:
        status = path.stat()
    except OSError:
        return 0, 0
    return status.st_size, status.st_mtime_ns


def _key(scan: InputScan) -> str:
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
