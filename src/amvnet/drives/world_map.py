"""Collect the static world of a drive in one labelled cloud, with one point for each voxel."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import torch
from numpy.typing import NDArray

from amvnet.data.class_maps import class_map
from amvnet.data.formats.registry import check_packages
from amvnet.data.labels.writers import Columns, write_cloud
from amvnet.data.poses import Poses
from amvnet.data.taxonomy import Taxonomy
from amvnet.drives.consensus import (
    LARGEST_INDEX,
    STEPS,
    VoxelTable,
    index_of,
    keys_of,
    sum_by,
    weighted_logs,
)
from amvnet.errors import InputError
from amvnet.files import Signature, atomic_write

MOVABLE = ("vehicle", "two-wheeler", "person")  # coarse classes whose points may move

_PLY = (
    rb"ply\nformat binary_little_endian 1\.0\nelement vertex \d+\n"
    rb"property double x\nproperty double y\nproperty double z\n.*property (int|ushort) sights\n"
)
# The program that wrote a LAS file stands at byte 58 of it.
PROGRAM = "amvnet map"
_LAS = rb"LASF.{54}" + PROGRAM.encode()
# The files of a map, by their ending.
SIGNATURES = {
    ".ply": Signature("a map", _PLY),
    ".las": Signature("a map in LAS", _LAS),
    ".laz": Signature("a map in LAZ", _LAS),
}
FIGURES = Signature("figures of map", rb'\{\s*"scans": ')


@dataclass(frozen=True)
class WorldMap:
    """The voxels of a map.

    Attributes:
        xyz: (V, 3) float64 mean of the points in each voxel, in the world, metres.
        labels: (V,) uint8 train ids.
        confidence: (V,) float32 probability of the label, in [0, 1].
        sights: (V,) int32 number of scans that see the voxel.
    """

    xyz: NDArray[np.float64]
    labels: NDArray[np.uint8]
    confidence: NDArray[np.float32]
    sights: NDArray[np.int32]
    taxonomy: Taxonomy

    def __len__(self) -> int:
        return len(self.labels)

    def figures(self, scans: int) -> dict[str, Any]:
        """Return the figures of a map of some scans, for JSON: all voxels, and those by class."""
        counts = np.bincount(self.labels, minlength=self.taxonomy.size + 1).tolist()
        classes = dict(zip(self.taxonomy.classes, counts[1:], strict=True))
        return {"scans": scans, "voxels": len(self), "classes": classes}

    def write(self, path: Path) -> None:
        """Write the map as `.ply`, `.las` or `.laz`; the file appears whole or not at all.

        A PLY has x, y, z (double), red, green, blue (uchar), class (raw id, int), confidence
        (float) and sights (int). LAS and LAZ have these values as coordinates, colours,
        classification and two extra dimensions.

        Raises:
            InputError: if the ending is another one, or laspy is missing.
        """
        check_ending(path)
        xyz: Columns = dict(zip("xyz", self.xyz.T, strict=True))
        others: Columns = {"confidence": self.confidence, "sights": self.sights}
        with atomic_write(path) as part:
            write_cloud(part, xyz, self.labels, self.taxonomy, others, program=PROGRAM)


class MapBuilder:
    """Adds the scans of a drive to a map. Its memory grows with the world that the drive sees.

    The class of a voxel is the class with the largest mean log score of its points, as in
    `Consensus`, over all scans of the drive.

    Args:
        size: edge of the voxels, metres.
    """

    def __init__(self, size: float, taxonomy: Taxonomy) -> None:
        self.size = size
        self.taxonomy = taxonomy
        # Log scores and their weight; x, y, z within the voxel and the number of points.
        self._table = VoxelTable(taxonomy.size + 1 + 4)
        self._origin: NDArray[np.floating] | None = None

    def add(self, xyz: NDArray[np.floating], scores: NDArray[np.floating], pose: Poses) -> None:
        """Add a scan: points (N, 3) in metres, their scores (N, K), and the pose (4, 4).

        Raises:
            InputError: if a point is farther from the first scan than the map reaches.
        """
        if self._origin is None:
            self._origin = np.floor(pose[:3, 3])
        has_scores, _, weighted = weighted_logs(scores)
        world = np.asarray(xyz, np.float64)[has_scores] @ pose[:3, :3].T
        world += pose[:3, 3] - self._origin

        index = np.floor(world / self.size).astype(np.int64)
        within = (world - index * self.size).astype(np.float32)
        if len(index) and not -LARGEST_INDEX <= index.min() <= index.max() < LARGEST_INDEX:
            reach = LARGEST_INDEX * self.size / 1000
            raise InputError(
                f"expected a map within {reach:.0f} km of its first scan, found "
                f"{np.abs(world).max() / 1000:,.0f} km; correct the poses, or give a larger --voxel"
            )
        keys, inverse = np.unique(keys_of(index), return_inverse=True)
        values = np.concatenate((weighted, within, np.ones((len(world), 1), np.float32)), axis=1)
        self._table.add(keys, sum_by(inverse, values, len(keys)))

    def save(self, path: Path, request: str, done: int) -> None:
        """Write the unfinished map, so that `restore` can continue it.

        Args:
            request: a text that tells this map from others.
        """
        keys, sums, scans = self._table.contents()
        with atomic_write(path) as part, part.open("wb") as file:
            np.savez(
                file,
                request=request,
                done=done,
                origin=np.zeros(3) if self._origin is None else self._origin,
                keys=keys,
                sums=sums,
                scans=scans,
            )

    def restore(self, path: Path, request: str) -> int:
        """Continue an unfinished map, and return the number of scans that were added to it.

        Without a file that can be read, the map stays empty.

        Raises:
            InputError: if the file is of another map.
        """
        try:
            with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
                state = dict(file)
            earlier, done = str(state.pop("request")), int(state.pop("done"))
            origin = state.pop("origin")
        except (OSError, ValueError, EOFError, KeyError, BadZipFile):
            return 0
        if earlier != request:
            raise InputError(
                f"{path}: expected an unfinished map of the same scans, sensor, poses, "
                "weights and voxels, found another one; leave --resume out"
            )
        self._origin = origin
        self._table.restore(**state)
        return done

    def build(self, keeps_movable: bool = False) -> WorldMap:
        """Return the map; vehicles, two-wheelers and people only if it `keeps_movable`."""
        keys, sums, scans = self._table.contents()
        classes = self.taxonomy.size
        logs = torch.from_numpy(sums[:, :classes] / sums[:, classes : classes + 1] / STEPS)
        confidence, best = logs.softmax(dim=1).max(dim=1)
        labels = (best + 1).to(torch.uint8).numpy()

        xyz = index_of(keys) * self.size + sums[:, -4:-1] / sums[:, -1:]
        if self._origin is not None:
            xyz += self._origin
        is_kept = np.ones(len(keys), bool) if keeps_movable else ~self._is_movable()[labels]
        return WorldMap(
            xyz[is_kept],
            labels[is_kept],
            confidence.numpy()[is_kept],
            scans[is_kept],
            self.taxonomy,
        )

    def _is_movable(self) -> NDArray[np.bool_]:
        """Return (K + 1,) bool: the classes whose points may move, by train id."""
        coarse = class_map("coarse")
        ids = [coarse.target.names.index(name) for name in MOVABLE]
        is_movable: NDArray[np.bool_] = np.isin(coarse.table(self.taxonomy), ids)
        return is_movable


def check_ending(path: Path) -> None:
    """Raise InputError if a map cannot be written to a path because of its ending."""
    if path.suffix not in SIGNATURES:
        raise InputError(
            f"{path}: expected a name that ends in {', '.join(SIGNATURES)}, found "
            f"{path.suffix or 'no ending'}; rename it"
        )
    check_packages(path, path.suffix)
