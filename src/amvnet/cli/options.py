"""Options that verbs share, what they are given in words, and the processes that share them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from amvnet.cli.console import say, silence
from amvnet.errors import InputError, shown
from amvnet.models.methods import (
    METHODS,
    EngineName,
    MethodName,
    Precision,
    TtaName,
    widest_method,
)
from amvnet.progress import counted

if TYPE_CHECKING:
    from amvnet.data.class_maps import ClassMap
    from amvnet.data.datasets.base import Dataset, ScanRecord
    from amvnet.distributed import Processes
    from amvnet.inference.listing import ScanOptions
    from amvnet.inference.scores import ScorePair, Which
    from amvnet.inference.segmenter import Segmenter
    from amvnet.sensors.lidars import Sensor
    from amvnet.weights.file import Weights

Split = Literal["train", "val", "test", "all", "mini_train", "mini_val"]  # the last two: nuScenes

WEIGHTS = "sim-hdl64e"  # the built-in weights that are used by default
SHOWN = 20  # names of sequences in a line


@dataclass(frozen=True)
class ScanChoice:
    """The options that say which scans of the inputs to read, and how files hold them."""

    split: Split = "all"
    """of datasets, the official split."""
    sequences: str | None = None
    """of datasets, these sequences or scenes instead, separated by commas."""
    topic: str | None = None
    """of bags, the topic of the scans; default: the only one with scans."""
    columns: str | None = None
    """of .bin, .npy and text files, what their columns hold, in order: x,y,z,intensity,ring, and
    any other name for a column to leave out; default: as the values suggest."""
    dtype: str | None = None
    """of .bin files, the type of the numbers: float32, float64, ..., or one for each of the
    columns, separated by commas; default: as the values suggest."""

    def parse(self) -> ScanOptions:
        """Return the options as the inputs take them.

        Raises:
            InputError: if a value cannot be parsed.
        """
        from amvnet.data.formats.rows import parse_layout
        from amvnet.inference.listing import ScanOptions

        layout = parse_layout(self.columns, self.dtype)
        return ScanOptions(parse_names(self.sequences), self.split, self.topic, layout)


@dataclass(frozen=True)
class SensorChoice:
    """The options that say what is known of the sensor of scan files; the rest is measured."""

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


def join_processes(cuda: bool = False) -> Processes:
    """Join the processes of this job, if torchrun or SLURM started several; only one prints."""
    from amvnet.distributed import join

    processes = join(cuda)
    if not processes.first:
        silence()
    return processes


def open_data(data: str, taxonomy: Path | None = None) -> Dataset:
    """Open the dataset that a verb is given, with a user's YAML file of classes if there is one."""
    from amvnet.data.datasets.open import open_dataset
    from amvnet.data.taxonomy import taxonomy_from_yaml

    return open_dataset(data, None if taxonomy is None else taxonomy_from_yaml(taxonomy))


def parse_classes(name: str | None) -> ClassMap | None:
    """Return the map of classes with a name or of a YAML file; None if the option was left out.

    Raises:
        InputError: if there is no such map.
    """
    from amvnet.data.class_maps import class_map

    return None if name is None else class_map(name)


def make_segmenter(
    weights: Weights,
    device: str,
    engine: EngineName,
    precision: Precision,
    at_once: int | None,
    method: MethodName | None = None,
    tta: TtaName | None = None,
    tau: float | None = None,
    processes: Processes | None = None,
) -> Segmenter:
    """Return the segmenter of a verb.

    Args:
        weights: trained weights.
        device: as for --device.
        engine: as for --engine.
        precision: as for --precision.
        at_once: as for --at-once; None means the best number.
        method: by which it labels scans; by default the widest that the weights have parts for.
        tta: as for --tta.
        tau: as for --tau.
        processes: those that share the scans, each on a GPU of its own if there are several.

    Raises:
        InputError: if one of the options does not fit the weights or this machine.
    """
    from amvnet.export.engines import use_engine
    from amvnet.inference.segmenter import Segmenter
    from amvnet.models.precision import choose_device

    chosen = method or widest_method(weights.parts)
    device = choose_device(device, engine)
    if processes is not None:
        device = processes.device(device)
    segmenter = Segmenter(weights, device, chosen, precision, keep_memory=True, tta=tta, tau=tau)
    say(f"computing on {segmenter.hardware} in {segmenter.precision}")
    if at_once is not None:
        segmenter.at_once = at_once
    use_engine(segmenter, engine, say)
    return segmenter


def describe_records(records: Sequence[ScanRecord]) -> str:
    """Return how many scans there are, and of which sequences."""
    if not records:
        return "none"
    names = sorted({record.sequence for record in records})
    text = ", ".join(names[:SHOWN])
    if len(names) > SHOWN:
        text += f" and {len(names) - SHOWN} more"

    return f"{counted(len(records), 'scan')} of {text}"


def parse_names(text: str | None) -> list[str] | None:
    """Parse names separated by commas; None if the option was left out.

    Raises:
        InputError: if there is no name.
    """
    if text is None:
        return None
    stripped = [name.strip() for name in text.split(",")]
    names = [name for name in stripped if name]
    if not names:
        raise InputError(
            f"expected names of sequences with commas, found {text!r}; "
            "name some, or leave the option out"
        )

    return names


def parse_methods(text: str) -> list[str]:
    """Parse methods separated by commas.

    Raises:
        InputError: if a name is no method.
    """
    names = parse_names(text) or []
    for name in names:
        if name not in METHODS:
            raise InputError(
                f"expected methods of {', '.join(METHODS)}, found {name!r}; use some of them"
            )

    return names


def parse_numbers(text: str) -> list[int]:
    """Parse numbers from 1 separated by commas; return them sorted, each once.

    Raises:
        InputError: if one is no such number.
    """
    names = parse_names(text) or []
    if not all(re.fullmatch("0*[1-9][0-9]{0,5}", name) for name in names):
        raise InputError(
            f"expected numbers of neighbours with commas, found {shown(text)}; say 5,10,15"
        )
    return sorted({int(name) for name in names})


def parse_taus(text: str) -> list[float]:
    """Parse values of tau in [0, 1] separated by commas; return them sorted, each once.

    Raises:
        InputError: if one is no such number.
    """
    values = set()
    for name in parse_names(text) or [""]:
        try:
            value = float(name)
        except ValueError:
            value = -1.0
        if not 0 <= value <= 1:  # nor NaN
            raise InputError(
                f"expected values of tau from 0 to 1 with commas, found {text!r}; say 0.7,0.85,1"
            )
        values.add(value)
    return sorted(values)


def parse_scores(
    a: Path | None, b: Path | None, key_a: str | None, key_b: str | None, logits: Which | None
) -> ScorePair | None:
    """Return the scores of two models; None if no option names any.

    Raises:
        InputError: if a folder is missing.
    """
    from amvnet.inference.scores import ScorePair

    if a is not None and b is not None:
        return ScorePair.of(a, b, key_a, key_b, logits)
    if (a, b, key_a, key_b, logits) == (None,) * 5:
        return None
    raise InputError("expected --scores-a and --scores-b, found not both; give two models' scores")
