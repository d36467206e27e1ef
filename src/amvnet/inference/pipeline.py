"""Segment many scans: read, compute and write at the same time, with few scans in memory."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, suppress
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from amvnet.data.formats.detect import READERS
from amvnet.data.labels.label_bags import KINDS as BAG_KINDS
from amvnet.data.labels.writers import check_kind, write_uncertain
from amvnet.data.taxonomy import Taxonomy
from amvnet.distributed import ALONE, Processes
from amvnet.errors import InputError, SomeBroken
from amvnet.files import atomic_write, inside
from amvnet.inference.inputs import InputScan, LabelFormat, Labels, LoadedScan
from amvnet.inference.journal import Journal
from amvnet.inference.scan_stream import AHEAD, stream_groups
from amvnet.inference.segmentation import Segmentation
from amvnet.progress import Progress, no_progress
from amvnet.scan import Scan
from amvnet.written import WrittenFiles

UNCERTAIN_ENDING = ".uncertain.npy"
Result = Segmentation | InputError


@dataclass(frozen=True)
class OutputOptions:
    """What is written for each scan.

    Attributes:
        folder: the folder of predictions.
        kind: the format of scan files' labels, one of `writers.KINDS` or `label_bags.KINDS`;
            datasets have their own.
        scores: also write both networks' probabilities, float16 (N, K), as `rv` and `bev` in an
            `.npz`.
        uncertain: also write (N,) bool, the uncertain points, as `.uncertain.npy`.
        overwrite: replace files that this package did not write, too.

    Raises:
        InputError: if the format is unknown, or a library for it is missing.
    """

    folder: Path
    kind: str = "label"
    scores: bool = False
    uncertain: bool = False
    overwrite: bool = False

    def __post_init__(self) -> None:
        if self.kind not in BAG_KINDS:
            check_kind(self.kind)

    def paths_of(self, scan: InputScan) -> list[Path]:
        """Return the paths of a scan's files, relative to the folder."""
        paths = [scan.labels_path(self.kind)]
        if self.scores:
            paths.append(scan.scores_path)
        if self.uncertain:
            paths.append(scan.scores_path.with_suffix(UNCERTAIN_ENDING))
        return paths


@dataclass(frozen=True)
class ExecutionOptions:
    """How many scans are computed at a time, and by which processes.

    Attributes:
        batch: scans that go through the networks together; the labels are the same up to rounding.
        at_once: on a CPU, scans that are segmented at the same time, each with its share of the
            threads. None means as many as there are threads, at most 4; 1 on a GPU, or with an
            engine other than torch, which shares out the threads itself.
        resume: leave out the scans that an interrupted run into the same folder has done.
        processes: those that share the scans.

    Raises:
        InputError: if a number is below 1.
    """

    batch: int = 1
    at_once: int | None = None
    resume: bool = False
    processes: Processes = ALONE

    def __post_init__(self) -> None:
        for option, count in (("batch", self.batch), ("at-once", self.at_once)):
            if count is not None and count < 1:
                raise InputError(
                    f"expected one scan or more at a time, found {count}; set --{option}"
                )


class SegmentScans(Protocol):
    """Segments scans that have been read."""

    def __call__(self, inputs: Sequence[InputScan], scans: Sequence[Scan]) -> list[Segmentation]:
        """Return the results in the order of the scans.

        Args:
            inputs: where each scan is from.
            scans: the same scans, in memory.

        Raises:
            InputError: if one of them cannot be segmented.
        """


@dataclass(frozen=True)
class Segmented:
    """A scan that waits to be written; of its points, only what the writing needs is kept."""

    scan: InputScan
    file_xyz: np.ndarray | None
    result: Segmentation


@dataclass(frozen=True)
class Broken:
    """A scan that could not be read or segmented, and why: one line."""

    scan: InputScan
    fault: str


def _raise_faults(faults: list[str], total: int) -> None:
    """Raise SomeBroken if some of `total` scans are broken, InputError if all are."""
    if faults and len(faults) == total:
        others = len(faults) - 1
        more = f" (and {others} more scans, each broken)" if others else ""
        raise InputError(faults[0] + more)
    if faults:
        raise SomeBroken(
            f"{total - len(faults)} of {total} scans are segmented, {len(faults)} are broken",
            faults,
        )


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
    """Raise InputError if output files would lie among the scans and could be taken for scans."""
    labels_look_like_scans = f".{output.kind}" in READERS
    scores_look_like_scans = output.scores and scan.path.suffix.lower() == ".npz"
    folder = (output.folder / scan.scores_path).parent
    is_own_folder = folder.resolve() == scan.path.parent.resolve()
    if is_own_folder and (labels_look_like_scans or scores_look_like_scans):
        raise InputError(
            f"{scan.path}: expected another folder for the labels, found the scan's own; "
            "change --out"
        )


@dataclass(frozen=True)
class Pipeline:
    """Reads, segments and writes scans at the same time.

    Attributes:
        scans: the scans, for all processes together.
        segment: segments scans that have been read.
        output: what is written, and where.
        taxonomy: the classes of the labels.
        execution: how many scans at a time; an `at_once` of None means 1 here.
    """

    scans: Sequence[InputScan]
    segment: SegmentScans
    output: OutputOptions
    taxonomy: Taxonomy
    execution: ExecutionOptions = ExecutionOptions()

    def run(self, settings: Mapping[str, Any], progress: Progress = no_progress) -> int:
        """Segment the scans, and write the results.

        Args:
            settings: what the labels depend on, as JSON types; an interrupted run is resumed only
                with the same settings.

        Returns:
            The number of label files of these scans, with those of the run that is resumed.

        Raises:
            InputError: if two scans would have the same files, an output folder is that of a scan,
                a file of the user would be replaced, or all scans are broken.
            SomeBroken: at the end, if some of several scans are broken.
        """
        processes = self.execution.processes
        paths = list(chain.from_iterable(map(self.output.paths_of, self.scans)))
        for path in paths:
            inside(self.output.folder, path)
        _check_names(self.scans)
        for scan in self.scans:
            _check_folder(scan, self.output)

        written = WrittenFiles(self.output.folder)
        if not self.output.overwrite:
            written.check(paths)

        is_new = not self.output.folder.exists()
        journal = Journal(self.output.folder, settings, self.execution.resume, processes)
        if processes.first:
            written.claim(paths)
        processes.wait()  # so that no file is written before it is claimed

        share = processes.share(self.scans)
        remaining = [scan for scan in share if str(scan.scores_path) not in journal.done]

        faults: list[str] = []
        for done, (scan, fault) in enumerate(self.stream(remaining)):
            progress(done, len(remaining))
            if fault is None:
                journal.add(str(scan.scores_path))
            else:
                faults.append(fault)
        progress(len(remaining), len(remaining))
        journal.close()
        if processes.first:
            written.finish(paths)
            if is_new:
                with suppress(OSError):  # stays unless all scans were broken
                    self.output.folder.rmdir()

        all_faults = list(chain.from_iterable(processes.gather(faults)))
        _raise_faults(all_faults, len(self.scans))
        return len(self.scans)

    def stream(self, scans: Sequence[InputScan]) -> Iterator[tuple[InputScan, str | None]]:
        """Read, segment and write scans, of which only a few are in memory at a time.

        Yields:
            Each scan and None when its files are written, in order; or a scan that is broken and a
            line that says why, which may come before its turn.
        """
        groups = stream_groups(
            scans,
            load=lambda scan: scan.load(),
            compute=self._segment_group,
            batch=self.execution.batch,
            at_once=self.execution.at_once or 1,
        )
        writing = deque[tuple[InputScan, Future[None]]]()
        # Reading, computing and writing go on at the same time, each on other scans.
        with closing(groups), ThreadPoolExecutor(1) as writer:
            for outcome in chain.from_iterable(groups):
                if isinstance(outcome, Broken):
                    yield outcome.scan, outcome.fault
                    continue
                writing.append((outcome.scan, writer.submit(self._write, outcome)))
                # Those that are written are yielded at once, so that the journal has them.
                while writing and (len(writing) > AHEAD or writing[0][1].done()):
                    yield _wait(*writing.popleft())
            while writing:
                yield _wait(*writing.popleft())

    def _segment_group(
        self, group: Sequence[tuple[InputScan, Future[LoadedScan]]]
    ) -> list[Segmented | Broken]:
        """Wait for scans that are being read, and segment them together.

        Scans that cannot be read come first in the result.
        """
        outcomes: list[Segmented | Broken] = []
        scans: list[InputScan] = []
        loaded: list[LoadedScan] = []
        for scan, load in group:
            try:
                loaded.append(load.result())
                scans.append(scan)
            except InputError as error:
                outcomes.append(Broken(scan, str(error)))

        results = self._segment_scans(scans, [item.scan for item in loaded])
        for scan, scan_loaded, result in zip(scans, loaded, results, strict=True):
            if isinstance(result, InputError):
                outcomes.append(Broken(scan, str(result)))
            else:
                outcomes.append(Segmented(scan, scan_loaded.file_xyz, result))
        return outcomes

    def _segment_scans(self, inputs: Sequence[InputScan], scans: Sequence[Scan]) -> list[Result]:
        """Segment scans together; if that fails, one by one to find those that are broken."""
        if not scans:
            return []
        try:
            return list(self.segment(inputs, scans))
        except InputError as error:
            if len(scans) == 1:
                return [error]

        results: list[Result] = []
        for scan_input, scan in zip(inputs, scans, strict=True):
            results += self._segment_scans([scan_input], [scan])
        return results

    def _write(self, segmented: Segmented) -> None:
        """Write the files of a scan, the labels last: where they are, the others are too."""
        result = segmented.result
        folder = self.output.folder
        scores_path = inside(folder, segmented.scan.scores_path)

        if self.output.scores:
            write_scores(scores_path, result)
        if self.output.uncertain:
            write_uncertain(scores_path.with_suffix(UNCERTAIN_ENDING), result.uncertain)

        has_two_networks = result.rv is not None and result.bev is not None
        segmented.scan.write_labels(
            folder,
            LabelFormat(self.output.kind, self.taxonomy),
            Labels(result.labels, result.uncertain if has_two_networks else None),
            segmented.file_xyz,
        )


def _wait(scan: InputScan, writing: Future[None]) -> tuple[InputScan, None]:
    writing.result()  # raises the exception of a failed write
    return scan, None


def write_scores(path: Path, result: Segmentation) -> None:
    """Write both networks' probabilities, (N, K) float16, as `rv` and `bev` in an `.npz`."""
    arrays: dict[str, Any] = {}
    if result.rv is not None:
        arrays["rv"] = result.rv.astype(np.float16)
    if result.bev is not None:
        arrays["bev"] = result.bev.astype(np.float16)
    with atomic_write(path) as part:
        np.savez_compressed(part, **arrays)
