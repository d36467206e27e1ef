"""Teach networks by the consensus of an unlabelled drive."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from amvnet.config.recipes import load_recipe
from amvnet.config.schema import Recipe
from amvnet.data.datasets.base import Dataset
from amvnet.data.labels.ids import write_array
from amvnet.data.recordings import ScanFile, by_recording, distinct
from amvnet.data.taxonomy import CLASSES_BY_SENSOR
from amvnet.errors import InputError
from amvnet.files import alone_in, atomic_write, inside, temporary_folder
from amvnet.inference.drive import Drives, Labelled
from amvnet.inference.scan_stream import stream_scans
from amvnet.inference.segmentation import Segmentation
from amvnet.inference.segmenter import Segmenter
from amvnet.progress import Progress, no_progress
from amvnet.scan import Scan
from amvnet.training.plan import Plan, sized_by_init
from amvnet.training.run import train
from amvnet.weights.file import Weights, load, save

TEACHER = "teacher"  # the folder of the labels that teach, in the folder of the run
FIGURES = "figures.json"  # the figures of the scans under the weights that taught, in that folder
LEAST_PROBABILITY = 0.6  # a point teaches if its consensus has a larger one


@dataclass(frozen=True)
class Figures:
    """Figures of labels that need no truth.

    Attributes:
        uncertain: share of the points on which the networks disagree, in [0, 1].
        agreement: share of the points to which both networks give the same class, in [0, 1].
        consistency: share of the points whose label is that of the consensus, in [0, 1].
    """

    uncertain: float
    agreement: float
    consistency: float

    def __str__(self) -> str:
        return (
            f"{self.uncertain:.1%} of the points uncertain, both networks agree on "
            f"{self.agreement:.1%}, the consensus on {self.consistency:.1%}"
        )

    def is_better_than(self, other: Figures) -> bool:
        """Return whether fewer points are uncertain, and the networks agree on more."""
        return self.uncertain < other.uncertain and self.agreement > other.agreement


class TaughtScans(Dataset):
    """The scans of drives, with the labels that their consensus gives.

    `Dataset` documents the methods and their errors.
    """

    def __init__(self, scans: Sequence[ScanFile], folder: Path, weights: Weights) -> None:
        super().__init__(folder, weights.taxonomy)
        self._scans = dict(zip(label_paths(scans), scans, strict=True))

    def parts(self) -> dict[str, tuple[str, ...]]:
        """Return the recordings; all of them train."""
        recordings = tuple(recording.name for recording in by_recording(self._scans.values()))
        return {"train": recordings, "all": recordings}

    def records(self, sequences: Sequence[str]) -> list[ScanFile]:
        """Return the scans of some recordings, in order."""
        records = []
        for path, scan in self._scans.items():
            if scan.recording.name in sequences:
                name, labels = str(path.with_suffix("")), self.root / path
                record = replace(scan, name=name, sequence=scan.recording.name, dataset=self)
                records.append(replace(record, labels_path=labels, prediction=str(path)))
        return records

    def read(self, record: ScanFile, labels: bool = True) -> Scan:
        """Read one scan, normalised to the weights, and what its consensus teaches."""
        scan = self._scans[Path(record.prediction)].load()
        ids = self.raw_labels(record, len(scan)) if labels else None
        return replace(scan, labels=ids, name=record.name)

    def raw_labels(self, record: ScanFile, count: int) -> np.ndarray:
        """Return the (N,) train ids that teach; 0 for points that teach nothing."""
        assert record.labels_path is not None
        ids: np.ndarray = np.load(record.labels_path, allow_pickle=False)
        return ids

    def train_ids_by_raw(self) -> np.ndarray:
        """Return each train id as its own raw id."""
        return np.arange(self.taxonomy.size + 1, dtype=np.int16)


def label_paths(scans: Sequence[ScanFile]) -> list[Path]:
    """Return the paths of the labels that scans teach, relative to their folder, all different.

    The scans come recording by recording, as `Inputs.scans` returns them.
    """
    recordings = by_recording(scans)
    folders = distinct(name.name.strip("/").replace("/", "_") for name in recordings)
    paths = []
    for folder, members in zip(folders, recordings.values(), strict=True):
        for name in distinct(scan.scores_path.stem for scan in members):
            paths.append(Path(folder) / f"{name}.npy")
    return paths


def teach(
    scans: Sequence[ScanFile],
    drives: Drives | None,
    segmenter: Segmenter,
    folder: Path | None = None,
    progress: Progress = no_progress,
) -> Figures:
    """Label the scans of drives, and write what their consensus teaches.

    Args:
        drives: the poses of the scans, which are in order, or None if each scan teaches by its own
            labels.
        folder: the folder for the labels, or None to write nothing.

    Raises:
        InputError: if a scan cannot be read or segmented, or no point teaches.
    """
    counts = np.zeros(4)  # of points, of uncertain ones, and of those that agree in two ways
    taught = 0
    paths = label_paths(scans)
    fused = _fused(scans, drives, segmenter, progress)
    for path, (result, probabilities) in zip(paths, fused, strict=True):
        is_valid = result.labels > 0
        labels = np.where(is_valid, probabilities.argmax(axis=1) + 1, 0).astype(np.uint8)
        assert result.rv is not None
        assert result.bev is not None
        agrees = result.rv.argmax(axis=1) == result.bev.argmax(axis=1)
        for index, chosen in enumerate(
            (is_valid, result.uncertain, agrees & is_valid, (labels == result.labels) & is_valid)
        ):
            counts[index] += np.count_nonzero(chosen)

        if folder is not None:
            ids = np.where(probabilities.max(axis=1) > LEAST_PROBABILITY, labels, 0)
            taught += int(np.count_nonzero(ids))
            with atomic_write(inside(folder, path)) as part:
                write_array(part, ids)
    if folder is not None and not taught:
        raise InputError(
            f"expected points whose class has a probability over {LEAST_PROBABILITY}, found none; "
            "give more scans of the drive, or --weights that know such a sensor"
        )
    return Figures(*(float(share) for share in counts[1:] / max(counts[0], 1)))


def _fused(
    scans: Sequence[ScanFile], drives: Drives | None, segmenter: Segmenter, progress: Progress
) -> Iterator[tuple[Segmentation, np.ndarray]]:
    """Yield the result of each scan, and the probabilities (N, K) that its points get."""

    def segment(scan: ScanFile, loaded: Scan) -> Labelled:
        yaw = 0.0 if drives is None else drives.yaws[scan]
        return Labelled(scan, loaded, segmenter(loaded, yaw=yaw))

    outcomes = stream_scans(scans, lambda scan: scan.load(), segment, segmenter.at_once, progress)
    if drives is not None:
        for outcome, probabilities in drives.consensus_of(outcomes):
            assert isinstance(outcome, Labelled)
            yield outcome.result, probabilities
        return
    for outcome in outcomes:
        yield outcome.result, outcome.result.probabilities


def adapt(
    scans: Sequence[ScanFile],
    drives: Drives | None,
    weights: Weights,
    make_segmenter: Callable[[Weights], Segmenter],
    make_plan: Callable[[Dataset], Plan],
    score: Callable[[Segmenter], float] | None = None,
    *,
    request: str,
    progress: Callable[[str], AbstractContextManager[Progress]],
) -> Path:
    """Teach both networks by the consensus of their own labels over drives.

    Args:
        make_plan: returns the plan of the training, given the scans with their labels.
        score: returns the mIoU of a segmenter on labelled scans, which decides whether the trained
            weights are better; by default, figures without labels do.
        request: the digest of all that the labels depend on (`digest_of`).

    Returns:
        The path of the weights: the trained ones, or `weights` if they are not better.

    Raises:
        InputError: if a scan cannot be read; or as `train`.
    """
    plan = make_plan(TaughtScans(scans, Path(), weights))
    folder = plan.out / TEACHER
    before = _read_figures(folder, request, plan.resume)
    if before is None:
        plan.folder.check_place(plan.roots, plan.also_read)
        if plan.folder.is_run or os.path.lexists(folder):
            raise InputError(
                f"{plan.out}: expected a new folder or the folder of an earlier adapt, found "
                f"another run or {TEACHER}; give another folder"
            )
        with alone_in(plan.out, f".{TEACHER}.lock"), temporary_folder(plan.out) as part:
            with progress("labelling") as step:
                before = teach(scans, drives, make_segmenter(weights), part, step)
            (part / FIGURES).write_text(json.dumps({"request": request, **asdict(before)}))
            part.rename(folder)
    plan.report(f"before: {before}")

    path = train(make_plan(TaughtScans(scans, folder, weights)))
    with progress("comparing") as step:
        after = teach(scans, drives, make_segmenter(load(path)), progress=step)
    plan.report(f"after: {after}")
    is_better = after.is_better_than(before)
    if score is not None:
        old, new = (score(make_segmenter(chosen)) for chosen in (weights, load(path)))
        plan.report(f"mIoU of the labelled scans: {old:.1%} before, {new:.1%} after")
        is_better = new > old
    if not is_better:
        save(weights, path)
        plan.report("the labels are no better than before, so the weights stay as they were")
    return path


def _read_figures(folder: Path, request: str, resume: bool) -> Figures | None:
    """Return the figures of an earlier call that wrote all labels, or None if there was none.

    Raises:
        InputError: if the earlier call is not to be resumed, or was another one.
    """
    try:
        values = json.loads((folder / FIGURES).read_text())
        earlier = values.pop("request")
        figures = Figures(**values)
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return None
    if not resume:
        raise InputError(
            f"{folder.parent}: expected no earlier run, found one; add --resume or give another "
            "folder"
        )
    if earlier != request:
        raise InputError(
            f"{folder.parent}: expected the scans, sensor, poses and weights of the earlier run, "
            "found others; give another folder"
        )
    return figures


def recipe_for(weights: Weights, epochs: int | None, streets: float, seed: int | None) -> Recipe:
    """Return the recipe `adapt` with some values.

    Raises:
        InputError: if the streets of the weights' sensor cannot be simulated.
    """
    simulated = CLASSES_BY_SENSOR.get(weights.sensor)
    if streets and (simulated is None or simulated.classes != weights.taxonomy.classes):
        raise InputError(
            f"expected weights of a sensor and classes that can be simulated "
            f"({', '.join(CLASSES_BY_SENSOR)}), found {weights.sensor} with the classes of "
            f"{weights.taxonomy.name}; add --streets 0"
        )
    recipe = sized_by_init(load_recipe("adapt"), weights)
    training = replace(recipe.training, others=streets)
    if epochs is not None:
        training = replace(
            training,
            rv=replace(training.rv, epochs=epochs),
            bev=replace(training.bev, epochs=epochs),
        )
    if seed is not None:
        training = replace(training, seed=seed)
    return replace(recipe, training=training)
