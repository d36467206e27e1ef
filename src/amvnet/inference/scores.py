"""Read two models' scores from files for the late fusion, and check them."""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from amvnet.data.recordings import ScanFile
from amvnet.errors import InputError, one_line_errors
from amvnet.scan import Scan

# The least probability in a fusion. Without it, two models that are wholly sure of different
# classes would give a product of 0 for every class.
LEAST_PROBABILITY = 1e-7

# The largest error of the sum of a row: probabilities may be rounded to float16 or two decimals.
SUM_TOLERANCE = 0.02

ENDINGS = (".npz", ".npy")
# The name of each side's array in a file of `amvnet predict --scores`.
NETWORKS = {"a": "rv", "b": "bev"}
# The bytes at the end of a file that its digest covers: they hold the checksums of an .npz, and the
# last points of an .npy.
DIGESTED_BYTES = 4096

# The errors that NumPy raises for files that are not its own, truncated or corrupt.
READ_ERRORS = (ValueError, EOFError, OSError, BadZipFile, zlib.error)


@dataclass(frozen=True)
class ScoreFolder:
    """One model's scores of some scans, in one file per scan.

    Attributes:
        side: "a" or "b". In a file of `amvnet predict --scores`, a is the range-view network, and b
            is the bird's-eye-view network.
        folder: the folder of the files, in the layout of `amvnet predict --scores`.

    Raises:
        InputError: if there is no such folder.
    """

    side: str
    folder: Path
    logits: bool = False

    def __post_init__(self) -> None:
        if not self.folder.is_dir():
            raise InputError(
                f"{self.folder}: expected a folder of scores, found none; check the path"
            )

    def find(self, prediction: Path) -> Path:
        """Return the file of a scan's scores.

        Args:
            prediction: the path of the scan's labels in a folder of predictions. The file of scores
                has the same path, apart from the ending.

        Raises:
            InputError: if there is no such file.
        """
        for ending in ENDINGS:
            path = (self.folder / prediction).with_suffix(ending)
            if path.is_file():
                return path

        expected = (self.folder / prediction).with_suffix(ENDINGS[0])
        raise InputError(
            f"{expected}: expected the scores of this scan there, or as .npy, found none; "
            "lay them out as predict --scores does"
        )

    def read(self, prediction: Path, scan: Scan, classes: int) -> np.ndarray:
        """Return the (N, K) float32 class probabilities of a scan, from the file that `find` names.

        The rows of valid points are checked and completed by `as_probabilities`. The rows of other
        points are not checked.

        Raises:
            InputError: if there is no such file, or it does not hold scores of this scan's points.
        """
        path = self.find(prediction)
        scores = self._load(path)

        if scores.shape != (len(scan), classes):
            advice = "give the scores of this scan"
            if scores.shape == (classes, len(scan)):
                advice = "transpose them"
            elif scores.shape[-1:] == (classes + 1,):
                advice = "drop the column of points without a class"
            elif scores.ndim == 2 and len(scores) == len(scan):
                advice = "give a dataset or a YAML file that has the classes of the scores"
            raise InputError(
                f"{path}: expected scores of shape ({len(scan)}, {classes}), one row per point and "
                f"one column per class, found {scores.shape}; {advice}"
            )

        if scores.dtype.kind != "f":
            raise InputError(
                f"{path}: expected float scores, found {scores.dtype}; save class probabilities"
            )

        scores = scores.astype(np.float32)
        valid = scan.valid
        if self.logits:
            check_logits(scores[valid], str(path))
            return softmax(scores, axis=1)

        advice = f"apply softmax, or say --logits {self.side}"
        scores[valid] = as_probabilities(scores[valid], str(path), advice)
        return scores

    def _load(self, path: Path) -> np.ndarray:
        message = f"{path}: expected NumPy scores, found a broken file; write it again"
        # Opened here, because NumPy leaves the file open if an array in it is broken.
        with one_line_errors(lambda _: message, only=READ_ERRORS), path.open("rb") as file:
            content = np.load(file, allow_pickle=False)
            if isinstance(content, np.ndarray):
                return content

            with content:
                names = content.files
                name = names[0] if len(names) == 1 else NETWORKS[self.side]
                if name not in names:
                    raise InputError(
                        f"{path}: expected one array, or {name} among several, found "
                        f"{', '.join(names) or 'none'}; save the scores of one model"
                    )
                return np.asarray(content[name])


@dataclass(frozen=True)
class ScorePair:
    """Two models' scores of some scans, which are fused."""

    a: ScoreFolder
    b: ScoreFolder

    def read(self, prediction: Path, scan: Scan, classes: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the probabilities f and g of a scan, as `ScoreFolder.read` returns them."""
        return self.a.read(prediction, scan, classes), self.b.read(prediction, scan, classes)

    def digests(self, records: Sequence[ScanFile]) -> dict[str, str]:
        """Return a digest of each model's scores by side; it does not depend on the folders."""
        return {scores.side: _digest(scores, records) for scores in (self.a, self.b)}


def as_probabilities(values: np.ndarray, name: str, advice: str) -> np.ndarray:
    """Return (P, K) scores as class probabilities.

    Other tools write a row of zeros for a point outside their view: the model has no opinion of it.
    Such a row becomes 1/K in every class.

    Raises:
        InputError: if a value is negative or not finite, a row does not add up to 1, or all rows
            are zeros.
    """
    check_finite(values, name)

    is_silent = np.count_nonzero(values, axis=1) == 0
    if is_silent.any():
        if is_silent.all():
            raise InputError(
                f"{name}: expected class probabilities, found zeros in every row; "
                "give the scores of this scan"
            )
        values = np.where(is_silent[:, None], np.float32(1 / values.shape[1]), values)

    is_wrong = ~are_probabilities(values)
    if not is_wrong.any():
        return values

    row = int(is_wrong.argmax())
    raise InputError(
        f"{name}: expected class probabilities, found a row from {values[row].min():.3g} to "
        f"{values[row].max():.3g} with the sum {values[row].sum():.3g}; {advice}"
    )


def are_probabilities(values: np.ndarray) -> np.ndarray:
    """Return (P,) bool: whether each row of (P, K) finite scores holds probabilities.

    The probabilities may be rounded (`SUM_TOLERANCE`).
    """
    is_one: np.ndarray = np.abs(values.sum(axis=1) - 1) <= SUM_TOLERANCE
    return is_one & (values >= 0).all(axis=1)


def have_opinion(values: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return (P,) bool: whether each row of (P, K) probabilities prefers a class."""
    is_opinion: NDArray[np.bool_] = (values != values[:, :1]).any(axis=1)
    return is_opinion


def check_logits(values: np.ndarray, name: str) -> None:
    """Check (P, K) scores to which softmax is to be applied.

    Raises:
        InputError: if a score is not finite, or most rows are already probabilities: their softmax
            would be nearly the same for all classes.
    """
    check_finite(values, name)
    if np.count_nonzero(are_probabilities(values)) > len(values) / 2:
        raise InputError(
            f"{name}: expected scores before softmax, found probabilities: the rows add up to 1; "
            "leave out --logits for this model"
        )


def check_finite(values: np.ndarray, name: str) -> None:
    """Check that all scores are finite; raise InputError if one is NaN or infinite."""
    if not np.isfinite(values).all():
        raise InputError(
            f"{name}: expected finite scores, found NaN or infinity among them; give probabilities"
        )


def _digest(scores: ScoreFolder, records: Sequence[ScanFile]) -> str:
    """Return a digest of the scores of some scans, by the size and the end of each file."""
    digest = hashlib.sha256(repr((scores.side, scores.logits)).encode())

    for record in records:
        path = scores.find(Path(record.prediction))
        size = path.stat().st_size
        with path.open("rb") as file:
            file.seek(max(size - DIGESTED_BYTES, 0))
            end = file.read()
        digest.update(f"{record.name} {size} ".encode() + end)

    return digest.hexdigest()[:16]
