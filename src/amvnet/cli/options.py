"""Options that several commands share, the scans they choose, and the processes they start."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from amvnet.cli.console import report, silence
from amvnet.cli.parser import flag_of
from amvnet.config.bounds import Share
from amvnet.engines.compute import Compute
from amvnet.errors import InputError, counted, listed
from amvnet.files import FormatName
from amvnet.models.methods import MethodName, widest_method
from amvnet.sensors.lidars import AUTO, UNKNOWN_SENSOR, Sensor

if TYPE_CHECKING:
    from amvnet.data.class_maps import ClassMap
    from amvnet.data.datasets.base import Dataset
    from amvnet.data.datasets.training_data import Source
    from amvnet.data.recordings import ScanFile
    from amvnet.data.taxonomy import Taxonomy
    from amvnet.inference.drive import DriveOptions
    from amvnet.inference.listing import Inputs
    from amvnet.inference.request import LabellingRequest
    from amvnet.inference.scores import ScorePair
    from amvnet.inference.segmenter import Segmenter
    from amvnet.runtime.distributed import Processes
    from amvnet.sensors.reading import Reading
    from amvnet.weights.file import Weights

# Only nuScenes has the last two splits.
SplitName = Literal["train", "val", "test", "all", "mini_train", "mini_val"]

MAX_SEQUENCES = 20  # largest number of sequences that a line names


@dataclass(frozen=True)
class ScanChoice:
    """Which scans of the inputs to read, and how files hold them."""

    split: SplitName = "all"
    """the official split, for datasets."""
    sequences: tuple[str, ...] | None = None
    """sequences or scenes instead of a split, separated by commas, for datasets."""
    topic: str | None = None
    """the topic of the scans, for bags; default: the only topic with scans."""
    columns: str | None = None
    """the columns of .bin, .npy and text files in their order, such as x,y,z,intensity,ring; a
    column with any other name is left out; default: by their names, or in this order."""
    dtype: str | None = None
    """the type of the numbers in .bin files, with --columns: float32, float64, ..., or a type for
    each column, separated by commas; default: float32."""

    def reading(self, sensor: SensorChoice | None = None) -> Reading:
        """Return how files and bags are read.

        Raises:
            InputError: if a value cannot be parsed; or as `SensorChoice.parse`.
        """
        from amvnet.data.formats.rows import parse_layout
        from amvnet.sensors.reading import Reading

        layout = parse_layout(self.columns, self.dtype)
        described = UNKNOWN_SENSOR if sensor is None else sensor.parse()
        return Reading(described, layout, self.topic)

    def find(self, inputs: Sequence[str], sensor: SensorChoice | None = None) -> Inputs:
        """Return the inputs that a user names; the errors are those of `find_inputs`."""
        from amvnet.inference.listing import find_inputs

        return find_inputs(inputs, self.reading(sensor), self.sequences, self.split)


@dataclass(frozen=True)
class LabelledChoice:
    """Which labelled scans of the dataset to use."""

    split: SplitName | None = None
    """the split; default: val, and all for rank. If there is neither an official split nor one of
    your own, the last sequence validates."""
    sequences: tuple[str, ...] | None = None
    """sequences or scenes instead of a split, separated by commas."""

    def records(self, dataset: Dataset, default: SplitName = "val") -> Sequence[ScanFile]:
        """Return the scans, and report which scans they are.

        Raises:
            InputError: if there are none.
        """
        from amvnet.data.datasets.base import choose_records

        chosen = choose_records(dataset, self.sequences, self.split or default)
        records = dataset.labelled(chosen)
        text = f"labelled scans: {describe_records(records)}"
        if len(records) < len(chosen):
            text += f"; {len(chosen) - len(records)} others have no labels"
        if (self.sequences, self.split, dataset.split().is_given) == (None, None, False):
            every = dataset.having_labels(dataset.records(dataset.sequences("all")))
            if len(every) > len(records):
                text += f", those that validate without a split; --split all takes all {len(every)}"
        report(text)
        return records


@dataclass(frozen=True)
class TrainingChoice:
    """Which scans to train on and to validate with."""

    train_sequences: tuple[str, ...] | None = None
    """sequences or scenes to train on, separated by commas; default: the sequences of the split."""
    val_sequences: tuple[str, ...] | None = None
    """sequences or scenes to validate with, separated by commas; default: the sequences of the
    split, or the last sequence if there is no split."""

    def source(self, dataset: Dataset, with_val: bool = False) -> Source:
        """Return the labelled scans to train on and to validate with.

        Scans that are not used are reported.

        Args:
            with_val: whether to also train on the scans of the validation, and validate with none.

        Raises:
            InputError: if there are no such sequences, or no scans to train on.
        """
        from amvnet.data.datasets.training_data import to_train

        source = to_train(dataset, self.train_sequences, self.val_sequences, with_val)
        report_unused(source)
        return source

    def splits(self, dataset: Dataset) -> dict[str, list[ScanFile]]:
        """Return the scans of each split by its name, including scans without labels.

        Scans that the split does not name are reported.

        Raises:
            InputError: as `source`.
        """
        from amvnet.data.datasets.training_data import Source, named_sequences

        train, val = named_sequences(dataset, self.train_sequences, self.val_sequences)
        _report_split(Source.labelled(dataset, train, val))
        splits = {"train": dataset.records(train), "val": dataset.records(val)}
        test = dataset.having_labels(dataset.records(dataset.split().part("test")))
        if test:
            splits["test"] = test
        return splits


def report_unused(source: Source, title: str = "") -> None:
    """Report the scans that a training does not use, in lines that begin with `title`."""
    if source.unlabelled:
        report(f"{title}skipped for lack of labels: {describe_records(source.unlabelled)}")
    _report_split(source, title)


def _report_split(source: Source, title: str = "") -> None:
    """Report the scans of a dataset that its split does not name, or a split that nobody named."""
    split = source.dataset.split()
    if split.note and {record.sequence for record in source.val} == set(split.part("val")):
        report(f"{title}{split.note}")
    rest = source.dataset.records(split.part("rest") if split.is_given else ())
    used = {record.name for record in (*source.train, *source.val)}
    unnamed = [record for record in rest if record.name not in used]
    if unnamed:
        text = describe_records(unnamed)
        report(f"{title}not used, because the split does not name them: {text}")


@dataclass(frozen=True)
class SensorChoice:
    """What is known about the sensor of scan files; the rest is measured."""

    sensor: str | None = None
    """the name of the LiDAR (vlp16, os1-64, ...), or a YAML file; default: measured."""
    height: float | None = None
    """the height of the sensor above the ground, metres; default: measured."""
    intensity_scale: float | None = None
    """the largest possible intensity; default: 1, 255 or 65535, as the values suggest, and then
    spread as in the training of the weights."""
    unit: str | None = None
    """the unit of the coordinates: m, cm, mm or ft; default: m, or mm if it is certain."""
    axes: str | None = None
    """the directions of the axes: x-forward (y left), y-forward (x right), z-forward (y down),
    z-down (y right) or y-up (x right); default: by the ground."""
    rotate: str | None = None
    """the rotation that levels the scans: yaw,pitch,roll in degrees; default: by the ground."""
    offset: str | None = None
    """the vector x,y,z in metres that is added after the rotation, so that the sensor is at the
    origin; default: 0,0,0."""
    keep_own: bool = False
    """also label the points of the car's own body, which otherwise get no label."""

    def parse(self) -> Sensor:
        """Return the sensor with the attributes that are known.

        Raises:
            InputError: if there is no such sensor or file, or a value is impossible.
        """
        from amvnet.sensors.lidars import make_sensor

        return make_sensor(**asdict(self) | {"keep_own": self.keep_own or None})


@dataclass(frozen=True)
class LabelChoice:
    """How points are labelled, and which files are written for each scan."""

    method: MethodName = "amvnet"
    """the whole of AMVNet, or a part of it."""
    tau: Share | None = None
    """a point goes to the head if the cosine similarity of the two networks' probabilities is at
    most this value, in [0, 1]; a lower value takes less time; default: the value in the weights."""
    format: FormatName = "label"
    """the format of the labels of scan files: raw ids (label, npy), a table of the points (csv), or
    coloured points (ply, pcd, las, laz)."""
    classes: str | None = None
    """other classes, to which the classes of the weights are mapped: coarse, lidog, or a YAML
    file."""
    scores: bool = False
    """also write the probabilities of both networks."""
    uncertain: bool = False
    """also write NAME.uncertain.npy, which marks the points on which the two networks disagree."""

    def parse(
        self, weights: Weights, reading: Reading, compute: Compute, *of_data: Taxonomy
    ) -> LabellingRequest:
        """Return the request for labels by some weights, of data that may have classes.

        Raises:
            InputError: if a value cannot be parsed, or does not fit the weights.
        """
        from amvnet.inference.pipeline import LabelFiles
        from amvnet.inference.request import LabellingRequest

        return LabellingRequest(
            weights,
            method_for(weights, self.method),
            self.tau,
            precision=compute.precision,
            engine=compute.engine,
            reading=reading,
            classes=map_to(self.classes, weights.taxonomy, *of_data),
            files=LabelFiles(self.format, self.scores, self.uncertain),
        )


@dataclass(frozen=True)
class DriveChoice:
    """Whether the scores of drives are fused over time."""

    drive: bool = False
    """the scans of each sequence, folder or bag are a drive: fuse what they say of the same
    places."""
    poses: Path | None = None
    """with --drive, the poses of the LiDAR: KITTI's lines of 12 numbers, TUM's lines of time x y z
    qx qy qz qw, .npy (N, 4, 4), or a bag's topic of odometry, poses or tf; default: the dataset's,
    or estimated by KISS-ICP."""
    past_only: bool = False
    """with --drive, fuse each scan only with scans before it, as on a robot."""

    def parse(self) -> DriveOptions | None:
        """Return how drives are fused, or None if each scan is labelled alone.

        Raises:
            InputError: if an option needs --drive.
        """
        from amvnet.inference.drive import DriveOptions

        if self.drive:
            return DriveOptions(self.poses, self.past_only)
        for flag, is_given in (("--poses", self.poses), ("--past-only", self.past_only)):
            if is_given:
                raise InputError(f"{flag}: expected --drive, found none; add it")
        return None


@dataclass(frozen=True)
class ScoresChoice:
    """The scores of two other models."""

    scores_a: Path | None = None
    """a folder with one model's class probabilities: for each scan an .npz or .npy of shape (N, K),
    under the name that predict --scores gives it."""
    scores_b: Path | None = None
    """a folder with the other model's class probabilities. If both folders are from predict
    --scores, a takes the range view and b the bird's-eye view."""
    logits: Literal["a", "b", "both"] | None = None
    """which of the two models has scores before softmax instead of probabilities."""

    def parse(self) -> ScorePair | None:
        """Return the scores of the two models, or None if no option names any.

        Raises:
            InputError: if only one folder is named, or a folder is missing.
        """
        from amvnet.inference.scores import ScoreFolder, ScorePair

        if self == ScoresChoice():
            return None
        if self.scores_a is None or self.scores_b is None:
            raise InputError(
                "expected --scores-a and --scores-b, found only one; give the scores of two models"
            )
        return ScorePair(
            ScoreFolder("a", self.scores_a, self.logits in ("a", "both")),
            ScoreFolder("b", self.scores_b, self.logits in ("b", "both")),
        )


def given_options(choice: Any) -> list[str]:
    """Return the options of a choice whose values are not the defaults, as words of a command."""
    words = []
    for field in fields(choice):
        value = getattr(choice, field.name)
        if value != field.default:
            text = ",".join(value) if isinstance(value, tuple) else str(value)
            words.append(flag_of(field.name) + ("" if value is True else f"={text}"))
    return words


def open_inputs(
    inputs: Sequence[str], choice: ScanChoice, sensor: SensorChoice, weights: str, then: str = ""
) -> tuple[Inputs, str, Weights]:
    """Return the inputs that a user names, and the name of weights for them with the weights.

    The errors and the other arguments are those of `find_inputs` and `load_for`.
    """
    found = choice.find(inputs, sensor)
    return found, *load_for(found, weights, then)


def load_for(inputs: Inputs, weights: str, then: str = "") -> tuple[str, Weights]:
    """Return the name of the weights for some inputs, and the weights.

    If `weights` is "auto", the first recording of the inputs chooses among the built-in weights,
    and a line reports which are chosen and why.

    Args:
        then: the end of that line.

    Raises:
        InputError: if there are no such weights.
    """
    from amvnet.weights.file import load, unfinished_stages

    if weights == AUTO:
        weights, reason = inputs.choose_weights()
        report(f"weights {weights}, {reason}{then}")
    loaded = load(weights)
    stages = unfinished_stages(weights)
    if stages:
        report(
            f"warning: {weights} is a run that has not finished {' and '.join(stages)}: these are "
            f"the weights of its other stages; amvnet train ... --resume goes on"
        )
    return weights, loaded


def load_dataset(
    data: str, weights: str, any_classes: bool = False
) -> tuple[str, Weights, Dataset]:
    """Return the weights for a dataset by `load_for`, and the dataset, normalised to them.

    Lines report what is assumed of its sensors.

    Args:
        any_classes: whether the dataset may have other classes than the weights.

    Raises:
        InputError: if there are no such weights or no such dataset, or it has other classes.
    """
    from amvnet.data.datasets.open import open_dataset, with_classes
    from amvnet.inference.listing import Inputs
    from amvnet.sensors.normalise import Normaliser, normalised

    dataset = open_dataset(data)
    name, loaded = load_for(Inputs([dataset]), weights)
    if not any_classes:
        dataset = with_classes(dataset, loaded.taxonomy)
    return name, loaded, normalised(dataset, Normaliser(loaded.expects, report=report))


def map_to(classes: str | None, *taxonomies: Taxonomy) -> ClassMap | None:
    """Return the map of `--classes`, or None without one; the errors are those of `class_map`."""
    from amvnet.data.class_maps import class_map

    return None if classes is None else class_map(classes, *taxonomies)


def method_for(weights: Weights, method: MethodName = "amvnet") -> MethodName:
    """Return the method, or a part of AMVNet if the weights have no more; a line then says so."""
    widest = widest_method(weights.parts)
    if method != "amvnet" or widest == "amvnet":
        return method
    report(f"the weights have only {', '.join(weights.parts)}: the method is {widest}, not amvnet")
    return widest


def load_segmenter(
    weights: Weights | str, method: MethodName, compute: Compute, tau: float | None = None
) -> Segmenter:
    """Return the segmenter of `amvnet.load`, and report on which device it computes.

    On a CPU, the process keeps the memory that it frees (`keep_freed_memory`).

    Raises:
        InputError: if `amvnet.load` cannot make the segmenter.
    """
    from amvnet.inference.loading import load_with
    from amvnet.runtime.memory import keep_freed_memory

    segmenter = load_with(compute, weights, method, tau, report=report)
    if segmenter.device == "cpu":
        keep_freed_memory()
    return segmenter


def join_processes(cuda: bool = False) -> Processes:
    """Join the processes of this job, if torchrun or SLURM started several. Only one prints.

    Args:
        cuda: whether the processes compute on CUDA devices.
    """
    from amvnet.runtime.distributed import connect

    processes = connect(cuda)
    if not processes.first:
        silence()
    return processes


def describe_records(records: Sequence[ScanFile]) -> str:
    """Return in words the number of some scans, and the names of their sequences."""
    if not records:
        return "none"
    names = sorted({record.sequence for record in records})
    return f"{counted(len(records), 'scan')} of {listed(names, MAX_SEQUENCES)}"
