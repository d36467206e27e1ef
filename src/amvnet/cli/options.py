"""Parse what verbs are given in words, and join the processes that share them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from amvnet.cli.console import say, silence
from amvnet.errors import InputError
from amvnet.models.methods import (
    METHODS,
    EngineName,
    MethodName,
    Precision,
    TtaName,
    widest_method,
)

if TYPE_CHECKING:
    from amvnet.data.class_maps import ClassMap
    from amvnet.data.datasets.base import Dataset, ScanRecord
    from amvnet.distributed import Processes
    from amvnet.inference.score_files import ScorePair, Which
    from amvnet.inference.segmenter import Segmenter
    from amvnet.weights.file import Weights

# Those from the fifth on are nuScenes' own.
Split = Literal[
    "train", "val", "test", "all", "mini_train", "mini_val", "train_detect", "train_track"
]

WEIGHTS = "sim-hdl64e"  # the built-in weights that are used by default
SHOWN = 20  # names of sequences in a line


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

    return f"{len(records)} scans of {text}"


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
    if not all(name.isdecimal() and int(name) for name in names):
        raise InputError(f"expected numbers of neighbours with commas, found {text!r}; say 5,10,15")
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
    from amvnet.inference.score_files import ScorePair

    if a is not None and b is not None:
        return ScorePair.of(a, b, key_a, key_b, logits)
    if (a, b, key_a, key_b, logits) == (None,) * 5:
        return None
    raise InputError("expected --scores-a and --scores-b, found not both; give two models' scores")
