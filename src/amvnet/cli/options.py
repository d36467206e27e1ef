"""Options that several commands share, the scans they choose, and the processes they start."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from amvnet.cli.console import report, silence
from amvnet.config.bounds import Share
from amvnet.errors import InputError
from amvnet.models.methods import Compute, MethodName
from amvnet.progress import counted

if TYPE_CHECKING:
    from amvnet.data.datasets.base import Dataset, ScanRecord
    from amvnet.data.datasets.select import TrainingScans
    from amvnet.inference.listing import ScanOptions
    from amvnet.inference.request import LabellingRequest
    from amvnet.inference.scores import ScorePair
    from amvnet.inference.segmenter import Segmenter
    from amvnet.runtime.distributed import Processes
    from amvnet.sensors.lidars import Sensor
    from amvnet.weights.file import Weights

Split = Literal["train", "val", "test", "all", "mini_train", "mini_val"]  # the last two: nuScenes

FormatName = Literal["label", "npy", "ply"]  # of scan files' labels

WEIGHTS = "sim-hdl64e"  # the built-in weights that are used by default
SHOWN = 20  # names of sequences in a line


@dataclass(frozen=True)
class ScanChoice:
    """Which scans of the inputs to read, and how files hold them."""

    split: Split = "all"
    """of datasets, the official split."""
    sequences: tuple[str, ...] | None = None
    """of datasets, these sequences or scenes instead, separated by commas."""
    topic: str | None = None
    """of bags, the topic of the scans; default: the only one with scans."""
    columns: str | None = None
    """of .bin, .npy and text files, what their columns hold, in order: x,y,z,intensity,ring, and
    any other name for a column to leave out; default: by their names, or in this order."""
    dtype: str | None = None
    """of .bin files, with --columns, the type of the numbers: float32, float64, ..., or one for
    each of the columns, separated by commas; default: float32."""

    def parse(self) -> ScanOptions:
        """Return the options as the inputs take them.

        Raises:
            InputError: if a value cannot be parsed.
        """
        from amvnet.data.formats.rows import parse_layout
        from amvnet.inference.listing import ScanOptions

        layout = parse_layout(self.columns, self.dtype)
        return ScanOptions(self.sequences, self.split, topic=self.topic, layout=layout)


@dataclass(frozen=True)
class LabelledChoice:
    """Which labelled scans of the dataset to use."""

    split: Split | None = None
    """the split; default: val, and of rank: all. Without an official split or one of your own, the
    last sequence validates."""
    sequences: tuple[str, ...] | None = None
    """sequences or scenes instead, separated by commas."""

    def records(self, dataset: Dataset, default: Split = "val") -> Sequence[ScanRecord]:
        """Return the scans, and say which; raise InputError if there are none."""
        from amvnet.data.datasets.base import choose_records

        chosen = choose_records(dataset, self.sequences, self.split or default)
        records = dataset.labelled(chosen)
        text = f"labelled scans: {describe_records(records)}"
        if len(records) < len(chosen):
            text += f"; {len(chosen) - len(records)} others have no labels"
        report(text)
        return records


@dataclass(frozen=True)
class TrainingChoice:
    """Which scans to train on and to validate with."""

    train_sequences: tuple[str, ...] | None = None
    """sequences or scenes, separated by commas, to train on; default: the split's."""
    val_sequences: tuple[str, ...] | None = None
    """sequences or scenes, separated by commas, to validate with; default: those of the split, or
    without a split the last one."""

    def scans(self, dataset: Dataset, with_val: bool = False) -> TrainingScans:
        """Return the labelled scans; if `with_val`, those to validate with are trained on as well.

        Scans that the split of a user's own dataset does not name are said.
        """
        from amvnet.data.datasets.own import OwnScans
        from amvnet.data.datasets.select import split_records

        scans = split_records(dataset, self.train_sequences, self.val_sequences, with_val)
        if scans.unlabelled:
            report(f"skipped, as they have no labels: {describe_records(scans.unlabelled)}")
        if isinstance(dataset, OwnScans):
            used = {record.name for record in (*scans.train, *scans.val)}
            unnamed = [record for record in dataset.left_out() if record.name not in used]
            if unnamed:
                report(f"not used, as the split does not name them: {describe_records(unnamed)}")
        return scans

    def splits(self, dataset: Dataset) -> Iterator[tuple[str, Sequence[ScanRecord]]]:
        """Yield the scans by the name of their split, also those without labels."""
        from amvnet.data.datasets.select import named_sequences

        train, val = named_sequences(dataset, self.train_sequences, self.val_sequences)
        self.scans(dataset)  # says what is not used
        yield "train", dataset.records(train)
        yield "val", dataset.records(val)
        with suppress(InputError):  # there may be none
            yield "test", dataset.labelled(dataset.records(dataset.official("test")))


@dataclass(frozen=True)
class SensorChoice:
    """What is known of the sensor of scan files; the rest is measured."""

    sensor: str | None = None
    """of scan files, a LiDAR's name (vlp16, os1-64, ...) or a YAML file; default: measured."""
    height: float | None = None
    """of scan files, the sensor's height over the ground in metres; default: measured."""
    intensity_scale: float | None = None
    """of scan files, the largest possible intensity; default: 1, 255 or 65535, as the values
    suggest, and spread as in the training of the weights."""
    unit: str | None = None
    """of scan files, m, cm, mm or ft; default: m, or mm if they are certainly that."""
    axes: str | None = None
    """of scan files, x-forward (y left), y-forward (x right), z-forward (y down), z-down (y right)
    or y-up (x right); default: by the ground."""
    rotate: str | None = None
    """of scan files, the rotation that levels them: yaw,pitch,roll in degrees; default: by the
    ground."""
    offset: str | None = None
    """of scan files, what to add to x,y,z after the rotation, in metres, so that the sensor is at
    the origin."""

    def parse(self) -> Sensor:
        """Return what is known of the sensor.

        Raises:
            InputError: if there is no such sensor or file, or a value is impossible.
        """
        from amvnet.sensors.lidars import make_sensor

        return make_sensor(**asdict(self))


@dataclass(frozen=True)
class LabelChoice:
    """How points are labelled, and which files are written for each scan."""

    method: MethodName = "amvnet"
    """the whole of AMVNet, or a part of it."""
    tau: Share | None = None
    """points whose probabilities by the two networks have a cosine similarity of at most this go to
    the head, in [0, 1]; fewer points take less time; default: that of the weights."""
    format: FormatName = "label"
    """of scan files' labels: raw ids alone (label, npy), or coloured points (ply)."""
    classes: str | None = None
    """write the ids of these classes, to which the weights' classes are mapped: coarse, or a YAML
    file."""
    scores: bool = False
    """also write the probabilities of both networks."""
    uncertain: bool = False
    """also write which points the two networks disagree on, as NAME.uncertain.npy."""

    def parse(
        self, weights: Weights, choice: ScanChoice, known: SensorChoice, compute: Compute
    ) -> LabellingRequest:
        """Return the request for labels of some weights.

        Raises:
            InputError: if a value cannot be parsed, or does not fit the weights.
        """
        from amvnet.data.class_maps import class_map
        from amvnet.inference.request import LabellingRequest

        return LabellingRequest(
            weights,
            self.method,
            self.tau,
            precision=compute.precision,
            engine=compute.engine,
            sensor=known.parse(),
            layout=choice.parse().layout,
            topic=choice.topic,
            classes=None if self.classes is None else class_map(self.classes),
            kind=self.format,
            scores=self.scores,
            uncertain=self.uncertain,
        )


@dataclass(frozen=True)
class ScoresChoice:
    """The scores of two other models."""

    scores_a: Path | None = None
    """folder of one model's class probabilities, an .npz or .npy of shape (N, K) for each scan,
    where predict --scores writes its own."""
    scores_b: Path | None = None
    """folder of the other model's; of files of predict --scores with both networks, a is the range
    view and b the bird's-eye view."""
    logits: Literal["a", "b", "both"] | None = None
    """which of the two are scores before softmax."""

    def parse(self) -> ScorePair | None:
        """Return the scores of two models; None if no option names any.

        Raises:
            InputError: if only one is named, or a folder is missing.
        """
        from amvnet.inference.scores import ScoreFolder, ScorePair

        if self == ScoresChoice():
            return None
        if self.scores_a is None or self.scores_b is None:
            raise InputError(
                "expected --scores-a and --scores-b, found not both; give two models' scores"
            )
        return ScorePair(
            ScoreFolder("a", self.scores_a, self.logits in ("a", "both")),
            ScoreFolder("b", self.scores_b, self.logits in ("b", "both")),
        )


def load_segmenter(
    weights: Weights | str, method: MethodName, compute: Compute, tau: float | None = None
) -> Segmenter:
    """Return what `amvnet.load` does, for a command, and say what it computes on.

    On a CPU, the process keeps the memory that it frees.
    """
    from amvnet import load
    from amvnet.runtime.memory import keep_freed_memory

    segmenter = load(
        weights,
        compute.device,
        method,
        compute.precision,
        compute.engine,
        tau=tau,
        report=report,
    )
    if compute.at_once is not None:
        segmenter.at_once = compute.at_once
    if segmenter.device == "cpu":
        keep_freed_memory()
    return segmenter


def join_processes(cuda: bool = False) -> Processes:
    """Join the processes of this job, if torchrun or SLURM started several; only one prints."""
    from amvnet.runtime.distributed import join

    processes = join(cuda)
    if not processes.first:
        silence()
    return processes


def describe_records(records: Sequence[ScanRecord]) -> str:
    """Return in words how many scans there are, and from which sequences."""
    if not records:
        return "none"
    names = sorted({record.sequence for record in records})
    text = ", ".join(names[:SHOWN])
    if len(names) > SHOWN:
        text += f" and {len(names) - SHOWN} more"

    return f"{counted(len(records), 'scan')} of {text}"
