"""Class probabilities from files: what any two segmenters say of a scan, checked and read for the late fusion."""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal
from zipfile import BadZipFile

import numpy as np

from amvnet.data.datasets.base import ScanRecord
from amvnet.errors import InputError
from amvnet.scan import Scan

SURE = (
    1e-7  # two models that are wholly sure of different classes have a product of 0 for every class
)
ROUNDING = 0.02  # by which a row of K float16 probabilities, or of ones with two decimals, may miss a sum of 1
ENDINGS = (".npz", ".npy")
TAIL = 4096  # bytes at the end of a file: the checksums of an .npz, the last points of an .npy

Which = Literal["a", "b", "both"]


@dataclass(frozen=True)
class ScoreFolder:
    """One model's scores of some scans, a file for each.

    Attributes:
        side: "a" or "b", for messages.
        folder: where the files are, each at its scan's place.
        key: which array of an `.npz`; None where there is just one.
        logits: whether they are scores before softmax.
    """

    side: str
    folder: Path
    key: str | None = None
    logits: bool = False

    def find(self, place: Path) -> Path:
        """The file of the scan whose prediction would lie at `place` (relative); raises InputError where none is."""
        for ending in ENDINGS:
            if (path := (self.folder / place).with_suffix(ending)).is_file():
                return path
        first = (self.folder / place).with_suffix(ENDINGS[0])
        raise InputError(
            f"{first}: expected the scores of this scan there, or as .npy, found none; "
            "lay them out as predict --scores does"
        )

    def read(self, place: Path, scan: Scan, classes: int) -> np.ndarray:
        """(N, K) float32 class probabilities of one scan; rows of points that are not valid are as they come.

        Raises:
            InputError: where there is no such file, or not the probabilities of this scan's points in it.
        """
        path = self.find(place)
        found = self._array(path)
        if found.ndim != 2 or len(found) != len(scan) or found.shape[1] != classes:
            more = (
                "drop the column of points without a class"
                if found.shape[-1:] == (classes + 1,)
                else "give those"
            )
            raise InputError(
                f"{path}: expected scores of shape ({len(scan)}, {classes}), one row per point and one column per "
                f"class, found {found.shape}; {more}"
            )
        if found.dtype.kind != "f":
            raise InputError(
                f"{path}: expected float scores, found {found.dtype}; save class probabilities"
            )
        found = found.astype(np.float32)
        if self.logits:
            check_finite(found[scan.valid], str(path))
            return _softmax(found)
        check_probabilities(
            found[scan.valid], str(path), f"apply softmax, or say --logits {self.side}"
        )
        return found

    def _array(self, path: Path) -> np.ndarray:
        """The array of a file; nothing is ever unpickled."""
        with _readable(path):
            found = np.load(path, allow_pickle=False)
            if isinstance(found, np.ndarray):
                return found
            with found:
                return np.asarray(found[self._key(path, found.files)])

    def _key(self, path: Path, keys: Sequence[str]) -> str:
        if self.key is None and len(keys) == 1:
            return keys[0]
        if self.key in keys:
            return str(self.key)
        wanted = "one array" if self.key is None else f"the array {self.key}"
        raise InputError(
            f"{path}: expected {wanted}, found {', '.join(keys) or 'none'}; choose one with --key-{self.side}"
        )


@dataclass(frozen=True)
class ScorePair:
    """The scores of the two models that are fused."""

    a: ScoreFolder
    b: ScoreFolder

    @classmethod
    def of(
        cls, a: Path, b: Path, key_a: str | None, key_b: str | None, logits: Which | None
    ) -> ScorePair:
        """From what a user says.

        Raises:
            InputError: where a folder is not there.
        """
        for folder in (a, b):
            if not folder.is_dir():
                raise InputError(
                    f"{folder}: expected a folder of scores, found none; check the path"
                )
        first = ScoreFolder("a", a, key_a, logits in ("a", "both"))
        return cls(first, ScoreFolder("b", b, key_b, logits in ("b", "both")))

    def read(self, place: Path, scan: Scan, classes: int) -> tuple[np.ndarray, np.ndarray]:
        """f and g of a scan, as `ScoreFolder.read` has them."""
        return self.a.read(place, scan, classes), self.b.read(place, scan, classes)

    def to_dict(self) -> dict[str, Any]:
        """What a user said, by model."""
        return {one.side: asdict(one) | {"folder": str(one.folder)} for one in (self.a, self.b)}

    def options(self) -> list[str]:
        """The same as options of a command line."""
        found = [
            word for one in (self.a, self.b) for word in (f"--scores-{one.side}", str(one.folder))
        ]
        found += [
            word
            for one in (self.a, self.b)
            if one.key is not None
            for word in (f"--key-{one.side}", one.key)
        ]
        sides = [one.side for one in (self.a, self.b) if one.logits]
        return found + (["--logits", "both" if len(sides) == 2 else sides[0]] if sides else [])

    def digests(self, records: Sequence[ScanRecord]) -> dict[str, str]:
        """Tell the scores of some scans from other ones, wherever they lie."""
        return {one.side: _digest(one, records) for one in (self.a, self.b)}


def check_probabilities(values: np.ndarray, name: str, cure: str) -> None:
    """Raises InputError where (P, K) scores are not probabilities of classes; `cure` is what to do."""
    check_finite(values, name)
    sums = values.sum(axis=1)
    wrong = (np.abs(sums - 1) > ROUNDING) | (values < 0).any(axis=1)
    if wrong.any():
        row = int(wrong.argmax())
        raise InputError(
            f"{name}: expected class probabilities, found a row from {values[row].min():.3g} to "
            f"{values[row].max():.3g} with the sum {sums[row]:.3g}; {cure}"
        )


def check_finite(values: np.ndarray, name: str) -> None:
    """Raises InputError where a score is not a finite number."""
    if not np.isfinite(values).all():
        raise InputError(
            f"{name}: expected finite scores, found NaN or infinity among them; give probabilities"
        )


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Raises InputError where NumPy cannot read a file."""
    try:
        yield
    except InputError:
        raise
    except (ValueError, EOFError, OSError, BadZipFile, zlib.error):
        raise InputError(
            f"{path}: expected NumPy scores, found a broken file; write it again"
        ) from None


def _softmax(values: np.ndarray) -> np.ndarray:
    powers = np.exp(values - values.max(axis=1, keepdims=True))
    return powers / powers.sum(axis=1, keepdims=True)


def _digest(scores: ScoreFolder, records: Sequence[ScanRecord]) -> str:
    found = hashlib.sha256(repr((scores.key, scores.logits)).encode())
    for record in records:
        path = scores.find(Path(record.prediction))
        size = path.stat().st_size
        with path.open("rb") as file:
            file.seek(max(size - TAIL, 0))
            found.update(f"{record.name} {size} ".encode() + file.read())
    return found.hexdigest()[:16]
