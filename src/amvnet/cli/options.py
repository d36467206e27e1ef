"""What verbs are given: in words, data sets, names of sequences, numbers; and the processes that share them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from amvnet.cli.console import silence
from amvnet.errors import InputError

if TYPE_CHECKING:
    from amvnet.data.datasets.base import ScanRecord
    from amvnet.data.taxonomy import Taxonomy
    from amvnet.distributed import Processes
    from amvnet.inference.score_files import ScorePair, Which

SHOWN = 20  # names of sequences in a line


def join_processes(cuda: bool = False) -> Processes:
    """The processes of this job, where torchrun or SLURM has started several; only the first one prints."""
    from amvnet.distributed import join

    found = join(cuda)
    if not found.first:
        silence()
    return found


def open_data(data: str, taxonomy: Path | None, otherwise: Taxonomy | None = None) -> Any:
    """The data set that a verb is given, with a user's YAML file of classes, or other classes, if any."""
    from amvnet.data.datasets.open import open_dataset
    from amvnet.data.taxonomy import taxonomy_from_yaml

    return open_dataset(data, otherwise if taxonomy is None else taxonomy_from_yaml(taxonomy))


def describe_records(records: Sequence[ScanRecord]) -> str:
    """How many scans there are, of which sequences."""
    names = sorted({record.sequence for record in records})
    shown = ", ".join(names[:SHOWN]) + (
        f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    )
    return f"{len(records)} scans of {shown}" if records else "none"


def parse_names(text: str | None) -> list[str] | None:
    """Names with commas; None where the option was left out. Raises InputError where there is none in it."""
    names = None if text is None else [name.strip() for name in text.split(",") if name.strip()]
    if names == []:
        raise InputError(
            f"expected names of sequences with commas, found {text!r}; name some, or leave the option out"
        )
    return names


def parse_methods(text: str) -> list[str]:
    """Methods with commas. Raises InputError where one is none."""
    from amvnet.inference.methods import METHODS

    names = parse_names(text) or []
    if wrong := [name for name in names if name not in METHODS]:
        raise InputError(
            f"expected methods of {', '.join(METHODS)}, found {wrong[0]!r}; use some of them"
        )
    return names


def parse_numbers(text: str) -> list[int]:
    """Numbers from 1 with commas, ascending, each once. Raises InputError where one is none."""
    names = parse_names(text) or []
    if not all(name.isdecimal() and int(name) for name in names):
        raise InputError(f"expected numbers of neighbours with commas, found {text!r}; say 5,10,15")
    return sorted({int(name) for name in names})


def parse_scores(
    a: Path | None, b: Path | None, key_a: str | None, key_b: str | None, logits: Which | None
) -> ScorePair | None:
    """Two models' scores; None where no option names any. Raises InputError where a folder is missing."""
    from amvnet.inference.score_files import ScorePair

    if a is not None and b is not None:
        return ScorePair.of(a, b, key_a, key_b, logits)
    if (a, b, key_a, key_b, logits) == (None,) * 5:
        return None
    raise InputError("expected --scores-a and --scores-b, found not both; give two models' scores")
