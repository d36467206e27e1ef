"""Segments scans with what `amvnet export` wrote: NumPy, SciPy and ONNX Runtime, no torch; to read and to port."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from amvnet.config.nested import from_dict
from amvnet.config.schema import AssertionConfig, PointHeadConfig, PolarViewConfig, RangeViewConfig
from amvnet.errors import InputError
from amvnet.models.neighbours import nearest_others
from amvnet.scan import Scan

DESCRIPTION = "amvnet.json"  # beside the graphs
FORMAT = 2
POLAR = ("polar_points", "polar_pillars", "polar_map", "polar_scores")
GRAPHS = {
    "rv": ("range_net",),
    "bev": POLAR,
    "ensemble": ("range_net", *POLAR),
    "amvnet": ("range_net", *POLAR, "point_head"),
}  # by method
CHANNELS = 6  # x, y, z, intensity, range, mask
PART = 2048  # uncertain points that the head settles at a time
TINY = np.float32(1e-12)


@dataclass(frozen=True)
class OnnxSegmentation:
    """What is known of the N points of a scan, in their order; of one that is not finite: 0, False and zeros.

    Attributes:
        labels: (N,) uint8 train ids, 1..K.
        uncertain: (N,) bool: where the two networks disagree; all False for a single network.
        scores: (N, K) float32 that the labels are the largest of; column c belongs to id c + 1.
    """

    labels: np.ndarray
    uncertain: np.ndarray
    scores: np.ndarray


class OnnxSegmenter:
    """Gives every point of a scan its class, by exported graphs.

    Args:
        folder: what `amvnet export` wrote.
        providers: ONNX Runtime's execution providers, the preferred first; by default the CPU's.

    Raises:
        InputError: where the folder is not whole, or ONNX Runtime is not installed.
    """

    def __init__(
        self, folder: Path | str, providers: Sequence[str] = ("CPUExecutionProvider",)
    ) -> None:
        folder = Path(folder)
        self.description = said = _description(folder)
        self.method: str = said["method"]
        self.range_view = from_dict(RangeViewConfig, said.get("range_view", {}), str(folder))
        self.polar_view = from_dict(PolarViewConfig, said.get("polar_view", {}), str(folder))
        self.assertion = from_dict(AssertionConfig, said.get("assertion", {}), str(folder))
        self.head = from_dict(PointHeadConfig, said.get("point_head", {}), str(folder))
        self._graphs = {
            name: _session(folder, said["graphs"][name], providers) for name in GRAPHS[self.method]
        }
        self._check_sizes(folder, len(said["classes"]) - 1)

    def __call__(self, points: np.ndarray, ring: np.ndarray | None = None) -> OnnxSegmentation:
        """Segment one scan.

        Args:
            points: (N, 4) x, y, z in metres and intensity in [0, 1].
            ring: (N,) index of the laser, 0 the lowest, where the description says that rows are rings.

        Raises:
            InputError: where there is no finite point, the shapes do not fit, or rings are missing or out of range.
        """
        scan = Scan(
            np.asarray(points, dtype=np.float32), ring=None if ring is None else np.asarray(ring)
        )
        valid = scan.valid
        if not valid.any():
            raise InputError(
                "expected points to segment, found none that is finite; leave the scan out"
            )
        scores, uncertain = self._scores(
            scan.points[valid], None if scan.ring is None else scan.ring[valid]
        )
        labels = scores.argmax(axis=1).astype(np.uint8) + 1
        return OnnxSegmentation(
            *(_in_place(values, valid) for values in (labels, uncertain, scores))
        )

    def _check_sizes(self, folder: Path, k: int) -> None:
        """Raises InputError where the graphs have other sizes than the description."""
        a, b = self.range_view, self.polar_view
        last = {
            "range_net": [k, a.height, a.width],
            "polar_map": [b.radial, b.angular],
            "polar_scores": [b.vertical * k],
            "point_head": [self.head.neighbours, 2 * k + 4],
        }
        for name in set(last) & set(self._graphs):
            graph = self._graphs[name]
            shape = (
                graph.get_inputs()[1] if name == "point_head" else graph.get_outputs()[0]
            ).shape
            if (found := shape[-len(last[name]) :]) != last[name]:
                raise InputError(
                    f"{folder}: expected {name} of size {last[name]}, found {found}; export anew"
                )

    def _scores(self, points: np.ndarray, ring: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """(P, K) scores and (P,) uncertain of the valid points."""
        none = np.zeros(len(points), dtype=bool)
        if self.method == "rv":
            return self.score_range_view(points, ring), none
        if self.method == "bev":
            return self.score_polar_view(points), none
        f, g = self.score_range_view(points, ring), self.score_polar_view(points)
        uncertain, merged = disagree(self.assertion, f, g), np.sqrt(f * g)
        if self.method == "amvnet" and uncertain.any():
            merged[uncertain] = self._settle(points, f, g, uncertain)
        return merged, uncertain

    def score_range_view(self, points: np.ndarray, ring: np.ndarray | None = None) -> np.ndarray:
        """(P, K) class probabilities of finite points (P, 4) by the range view."""
        image, pixel = range_image(self.range_view, points, ring)
        scores = self._run("range_net", image)[0]  # (K, H, W)
        return softmax(scores.reshape(len(scores), -1)[:, pixel].T)

    def score_polar_view(self, points: np.ndarray) -> np.ndarray:
        """(P, K) class probabilities of finite points (P, 4) by the bird's-eye view."""
        c = self.polar_view
        features, pillar, voxel = polar_features(c, points)
        occupied, pooled = pool(pillar, self._run("polar_points", features))
        pillars = self._run("polar_pillars", pooled)  # (M, pillar)
        plane = np.zeros((c.radial * c.angular, pillars.shape[1]), dtype=np.float32)
        plane[occupied] = pillars
        image = np.ascontiguousarray(plane.T).reshape(1, -1, c.radial, c.angular)
        decoded = self._run("polar_map", image)[0].reshape(-1, c.radial * c.angular)[
            :, occupied
        ]  # (C', M)
        scores = self._run("polar_scores", np.ascontiguousarray(decoded.T))  # (M, Z * K)
        slot = np.searchsorted(occupied, pillar)
        return softmax(scores.reshape(len(occupied), c.vertical, -1)[slot, voxel])

    def _settle(
        self, points: np.ndarray, f: np.ndarray, g: np.ndarray, uncertain: np.ndarray
    ) -> np.ndarray:
        """(U, K) class probabilities of the uncertain points, from themselves and their neighbours."""
        index = np.flatnonzero(uncertain)
        near = nearest_others(points[:, :3], index, self.head.neighbours)
        table = np.concatenate([f, g, points], axis=1)
        found = []
        for start in range(0, len(index), PART):
            part = slice(start, start + PART)
            point, rows = table[index[part]], table[near[part]]
            rows[..., -4:] -= point[
                :, None, -4:
            ]  # the neighbours' x, y, z, intensity less the point's own
            point[:, -4:-1] *= np.float32(self.head.position_scale)
            found.append(self._run("point_head", point, rows))
        return softmax(np.concatenate(found))

    def _run(self, name: str, *inputs: np.ndarray) -> np.ndarray:
        names = [one["name"] for one in self.description["graphs"][name]["inputs"]]
        return np.asarray(self._graphs[name].run(None, dict(zip(names, inputs, strict=True)))[0])


def range_image(
    view: RangeViewConfig, points: np.ndarray, ring: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The image (1, 6, H, W) float32 of finite points (P, 4), and each point's pixel (P,), row by row.

    Raises:
        InputError: where rows are lasers and `ring` is missing or out of range.
    """
    xyz = points[:, :3]
    x, y, z = xyz.astype(np.float64).T
    distance = np.sqrt((xyz * xyz).sum(axis=1))
    column = _cell(0.5 - np.arctan2(y, x) / (2 * math.pi), view.width)
    if view.rows == "ring":
        row = view.height - 1 - _rings(ring, view.height)
    else:
        elevation = np.degrees(np.arctan2(z, np.sqrt(x * x + y * y)))
        row = _cell((view.fov_up - elevation) / (view.fov_up - view.fov_down), view.height)
    pixel = row * view.width + column
    # The farthest first: what is written last is the nearest point of a pixel, and of equally near ones the first.
    order = np.argsort(distance, kind="stable")[::-1]
    image = np.zeros((view.height * view.width, CHANNELS), dtype=np.float32)
    image[pixel[order]] = np.column_stack([points, distance, np.ones_like(distance)])[order]
    return np.ascontiguousarray(image.T).reshape(1, CHANNELS, view.height, view.width), pixel


def polar_features(
    view: PolarViewConfig, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The 9 features (P, 9) float32 of points (P, 4), and each one's pillar (P,) and voxel in it (P,)."""
    x, y, z = points[:, :3].astype(np.float64).T
    polar = np.stack([np.sqrt(x * x + y * y), np.arctan2(y, x), z], axis=1)
    low = np.array([view.radius_min, -math.pi, view.z_min])
    high = np.array([view.radius_max, math.pi, view.z_max])
    cells = np.array([view.radial, view.angular, view.vertical])
    cell = np.clip(np.floor((polar - low) / (high - low) * cells), 0, cells - 1)
    centre = low + (cell + 0.5) * (high - low) / cells
    features = np.concatenate(
        [polar - centre, polar, points[:, [0, 1, 3]]], axis=1, dtype=np.float32
    )
    radius, angle, voxel = cell.astype(np.int64).T
    return features, radius * view.angular + angle, voxel


def pool(pillar: np.ndarray, features: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The occupied pillars (M,), ascending, and the maximum (M, C) over the features (P, C) of the points of each."""
    order = np.argsort(pillar, kind="stable")
    occupied, starts = np.unique(pillar[order], return_index=True)
    return occupied, np.maximum.reduceat(features[order], starts, axis=0)


def disagree(assertion: AssertionConfig, f: np.ndarray, g: np.ndarray) -> np.ndarray:
    """(P,) bool: which points are uncertain, by the probabilities f and g (P, K) of the two networks."""
    if assertion.name == "entropy":
        mean = (f + g) / 2
        return -(mean * np.log(np.maximum(mean, TINY))).sum(axis=1) >= assertion.threshold
    length = (f * f).sum(axis=1) * (g * g).sum(axis=1)
    return (f * g).sum(axis=1) / np.sqrt(np.maximum(length, TINY)) <= assertion.threshold


def softmax(scores: np.ndarray) -> np.ndarray:
    """(P, K) scores -> probabilities."""
    powers = np.exp(scores - scores.max(axis=1, keepdims=True))
    return powers / powers.sum(axis=1, keepdims=True)


def _cell(share: np.ndarray, cells: int) -> np.ndarray:
    """Which of `cells` equal parts of [0, 1] a number is in; the first or last one if outside."""
    return np.clip(np.floor(share * cells).astype(np.int64), 0, cells - 1)


def _rings(ring: np.ndarray | None, height: int) -> np.ndarray:
    if ring is None:
        raise InputError(
            "expected a scan with a ring index, found none; use a model with rows by elevation"
        )
    if not 0 <= ring.min() <= ring.max() < height:
        found = f"{ring.min()} to {ring.max()}"
        raise InputError(
            f"expected ring indices from 0 to {height - 1}, found {found}; use a model for this sensor"
        )
    return ring.astype(np.int64)


def _in_place(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """(P, ...) of the valid points -> (N, ...) of all, zeros for the others."""
    out = np.zeros((len(valid), *values.shape[1:]), dtype=values.dtype)
    out[valid] = values
    return out


def _description(folder: Path) -> dict[str, Any]:
    try:
        said = json.loads((folder / DESCRIPTION).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        raise InputError(
            f"{folder}: expected {DESCRIPTION} of amvnet export, found none; export anew"
        ) from None
    if (
        not isinstance(said, dict)
        or said.get("format") != FORMAT
        or said.get("method") not in list(GRAPHS)
    ):
        raise InputError(
            f"{folder / DESCRIPTION}: expected format {FORMAT} and a method, found others; export anew"
        )
    graphs = said.get("graphs")
    for name in GRAPHS[said["method"]]:
        if not isinstance(graphs, dict) or not _complete(graphs.get(name)):
            raise InputError(
                f"{folder / DESCRIPTION}: expected the graph {name}, found no such; export anew"
            )
    if not isinstance(said.get("classes"), list):
        raise InputError(f"{folder / DESCRIPTION}: expected classes, found none; export anew")
    return said


def _complete(graph: Any) -> bool:
    """Whether a graph's description has its file and its inputs."""
    if not isinstance(graph, dict) or not isinstance(graph.get("file"), str):
        return False
    inputs = graph.get("inputs")
    return isinstance(inputs, list) and all(isinstance(one, dict) for one in inputs)


def _session(folder: Path, graph: Mapping[str, Any], providers: Sequence[str]) -> Any:
    """ONNX Runtime on a graph; raises InputError where it is not the described one."""
    try:
        import onnxruntime
    except ImportError:
        raise InputError(
            "expected onnxruntime to run the graphs, found none; pip install onnxruntime"
        ) from None
    path = folder / graph["file"]
    if not path.is_file():
        raise InputError(f"{path}: expected a graph of amvnet export, found no file; export anew")
    try:
        session = onnxruntime.InferenceSession(str(path), providers=list(providers))
    except Exception as error:  # of a dozen classes that the runtime does not share with others
        said = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(
            f"{path}: expected a graph of amvnet export, found: {said}; export anew"
        ) from None
    found = [(one.name, one.shape) for one in session.get_inputs()]
    expected = [(one.get("name"), one.get("shape")) for one in graph["inputs"]]
    if found != expected:
        raise InputError(f"{path}: expected the inputs {expected}, found {found}; export anew")
    return session
