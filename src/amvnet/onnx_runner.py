"""Segment scans with the files of `amvnet export`, without torch.

It needs only NumPy, SciPy and ONNX Runtime, and is meant to be ported to other languages.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amvnet.config.nested import from_dict
from amvnet.config.schema import AssertionConfig, PointHeadConfig, PolarViewConfig, RangeViewConfig
from amvnet.data.formats.cloud import Cloud
from amvnet.errors import InputError, errors_of, reason_of
from amvnet.models.neighbours import nearest_others
from amvnet.scan import AnyArray, Scan, as_array, check_scan
from amvnet.sensors.expectation import Expectation
from amvnet.sensors.frame import check_metres
from amvnet.sensors.lidars import Sensor
from amvnet.sensors.own_body import mark_own

DESCRIPTION = "amvnet.json"  # name of the file that describes the graphs in its folder
LONGEST_NAME = 200  # longest file name of a graph, characters
FORMAT = 3  # version of the description
POLAR_GRAPHS = ("polar_points", "polar_pillars", "polar_map", "polar_scores")
# The graphs that each method needs.
GRAPHS_BY_METHOD = {
    "rv": ("range_net",),
    "bev": POLAR_GRAPHS,
    "ensemble": ("range_net", *POLAR_GRAPHS),
    "amvnet": ("range_net", *POLAR_GRAPHS, "point_head"),
}
CHANNELS = 6  # channels of the range image: x, y, z, intensity, range, mask
WINDOW = 5  # height and width of the window around a hidden point's pixel, pixels
OWN_WEIGHT = 1e-3  # weight of a hidden point's own pixel
LARGEST_DESCRIPTION = 10_000_000  # largest size of amvnet.json, bytes
HEAD_BATCH = 2048  # number of disputed points that the point head classifies at a time
TINY = np.float32(1e-12)  # smallest divisor


@dataclass(frozen=True)
class OnnxSegmentation:
    """The results for the N points of a scan, in their order.

    Attributes:
        labels: (N,) uint8 train ids, 1..K; 0 for points that are not valid (`Scan.valid`).
        uncertain: (N,) bool: whether the two networks disagree; False for a single network.
        scores: (N, K) float32 probabilities. Column c belongs to train id c + 1. Points that are
            not valid have zeros. The rows of an ensemble do not add up to 1.
    """

    labels: np.ndarray
    uncertain: np.ndarray
    scores: np.ndarray


class OnnxSegmenter:
    """A segmenter that runs exported graphs.

    Args:
        folder: the output folder of `amvnet export`.
        providers: ONNX Runtime's execution providers, the preferred one first.
        keep_own: label the points of the car's own body as others. By default, they get the id 0.

    Raises:
        InputError: if the folder is incomplete, or ONNX Runtime is not installed.
    """

    def __init__(
        self,
        folder: Path | str,
        providers: Sequence[str] = ("CPUExecutionProvider",),
        keep_own: bool = False,
    ) -> None:
        folder = Path(folder)
        description = read_description(folder)
        source = str(folder)

        self.description = description
        self.keep_own = keep_own
        self.method: str = description["method"]
        self.range_view = from_dict(RangeViewConfig, description.get("range_view", {}), source)
        self.polar_view = from_dict(PolarViewConfig, description.get("polar_view", {}), source)
        assertion = description.get("assertion", {})
        if isinstance(assertion, dict):  # its name is for readers of the file; there is only one
            assertion = {key: value for key, value in assertion.items() if key != "name"}
        self.assertion = from_dict(AssertionConfig, assertion, source)
        self.head = from_dict(PointHeadConfig, description.get("point_head", {}), source)
        with errors_of(source):
            self.expects = Expectation.from_dict(description.get("expects"), self.range_view)

        self._graphs: dict[str, Any] = {}
        for name in GRAPHS_BY_METHOD[self.method]:
            self._graphs[name] = _open_graph(folder, description["graphs"][name], providers)
        self._check_sizes(folder, len(description["classes"]) - 1)

    def __call__(self, points: AnyArray | Scan, ring: np.ndarray | None = None) -> OnnxSegmentation:
        """Segment one scan.

        Args:
            points: (N, 4) x, y, z in metres and intensity in [0, 1]; or a `Scan`.
            ring: (N,) index of the laser; 0 is the lowest. It is needed if the rows of the exported
                range view are rings.

        Raises:
            InputError: if no point is valid; if an array is clearly not in metres; if more than a
                few intensities are out of range; if the shapes do not fit; or if rings are missing
                or out of range.
        """
        if isinstance(points, Scan):
            scan = replace(points, points=np.asarray(points.points, np.float32))
        else:
            ring = None if ring is None else np.asarray(ring)
            table = as_array(points, "points of shape (N, 4)")
            if table.dtype.names is not None:
                raise InputError(
                    "expected points of shape (N, 4), found named columns; stack x, y, z, intensity"
                )
            with np.errstate(over="ignore", invalid="ignore"):  # too large for float32: not valid
                table = table.astype(np.float32)
            scan = Scan(table, ring=ring)
            with errors_of("scan"):
                check_metres(Cloud(table[:, :3]))
            scan = mark_own(check_scan(scan), Sensor(keep_own=self.keep_own))
        scan = self.expects.prepare(check_scan(scan))

        valid = scan.valid
        scores, uncertain = self._scores(scan.select(valid))
        labels = scores.argmax(axis=1).astype(np.uint8) + 1
        return OnnxSegmentation(
            labels=_fill_in(labels, valid),
            uncertain=_fill_in(uncertain, valid),
            scores=_fill_in(scores, valid),
        )

    def _check_sizes(self, folder: Path, k: int) -> None:
        image = self.range_view
        grid = self.polar_view
        expected_sizes = {
            "range_net": [k, image.height, image.width],
            "polar_map": [grid.radial, grid.angular],
            "polar_scores": [grid.vertical * k],
            "point_head": [self.head.neighbours, 2 * k + 4],
        }
        for name, expected in expected_sizes.items():
            if name not in self._graphs:
                continue

            graph = self._graphs[name]
            value = graph.get_inputs()[1] if name == "point_head" else graph.get_outputs()[0]
            size = value.shape[-len(expected) :]
            if size != expected:
                raise InputError(
                    f"{folder}: expected {name} of size {expected}, found {size}; export again"
                )

    def _scores(self, scan: Scan) -> tuple[np.ndarray, np.ndarray]:
        """Return (P, K) probabilities of finite points, and (P,) bool: the uncertain points."""
        points = scan.points
        none_uncertain = np.zeros(len(points), dtype=bool)
        if self.method == "rv":
            return self.score_range_view(scan), none_uncertain
        if self.method == "bev":
            return self.score_polar_view(points), none_uncertain

        f = self.score_range_view(scan)
        g = self.score_polar_view(points)
        uncertain = disagree(self.assertion, f, g)
        merged = np.sqrt(f * g)
        disputed = disputed_points(self.assertion, f, g, uncertain)
        if self.method == "amvnet" and disputed.any():
            merged[disputed] = self._classify(points, f, g, disputed)
        return merged, uncertain

    def score_range_view(self, scan: Scan) -> np.ndarray:
        """Return (P, K) class probabilities of finite points by the range view."""
        image, pixel = range_image(self.range_view, scan)
        logits = self._run("range_net", image)[0]  # (K, H, W)
        scores = softmax(logits.reshape(len(logits), -1).T)  # (H * W, K)
        return scores_of_points(self.range_view, image, pixel, distances(scan.points), scores)

    def score_polar_view(self, points: np.ndarray) -> np.ndarray:
        """Return (P, K) class probabilities of finite points (P, 4) by the bird's-eye view."""
        c = self.polar_view
        features, pillar, voxel = polar_features(c, points)
        is_far = distances(points) >= c.nearest
        seen, pooled = pool(pillar[is_far], self._run("polar_points", features[is_far]))
        pillars = self._run("polar_pillars", pooled)  # (F, C)

        occupied = np.unique(pillar)  # (M,)
        plane = np.zeros((c.radial * c.angular, pillars.shape[1]), dtype=np.float32)
        plane[seen] = pillars
        image = np.ascontiguousarray(plane.T).reshape(1, -1, c.radial, c.angular)
        decoded = self._run("polar_map", image)[0]  # (C', R, A)

        decoded = decoded.reshape(-1, c.radial * c.angular)[:, occupied]  # (C', M)
        scores = self._run("polar_scores", np.ascontiguousarray(decoded.T))  # (M, Z * K)
        slot = np.searchsorted(occupied, pillar)
        return softmax(scores.reshape(len(occupied), c.vertical, -1)[slot, voxel])

    def _classify(
        self, points: np.ndarray, f: np.ndarray, g: np.ndarray, disputed: np.ndarray
    ) -> np.ndarray:
        """Return (U, K) class probabilities of the disputed points by the point head."""
        index, cube = first_in_cubes(points, np.flatnonzero(disputed), self.head.cell)
        near = nearest_others(points[:, :3], index, self.head.neighbours)
        table = np.concatenate([f, g, points], axis=1)

        logits = []
        for start in range(0, len(index), HEAD_BATCH):
            part = slice(start, start + HEAD_BATCH)
            point = table[index[part]]
            rows = table[near[part]]
            rows[..., -4:] -= point[:, None, -4:]  # x, y, z, intensity relative to the point
            point[:, -4:-1] *= np.float32(self.head.position_scale)
            logits.append(self._run("point_head", point, rows))
        scores: np.ndarray = softmax(np.concatenate(logits))[cube]
        return scores

    def _run(self, name: str, *inputs: np.ndarray) -> np.ndarray:
        names = [entry["name"] for entry in self.description["graphs"][name]["inputs"]]
        feed = dict(zip(names, inputs, strict=True))
        return np.asarray(self._graphs[name].run(None, feed)[0])


def range_image(view: RangeViewConfig, scan: Scan) -> tuple[np.ndarray, np.ndarray]:
    """Project P finite points to a range image.

    Returns:
        The image (1, 6, H, W) float32, and the (P,) pixel of each point, counted row by row.

    Raises:
        InputError: if the rows are rings, and the scan has no rings or a ring is out of range.
    """
    points = scan.points
    x, y, _ = points[:, :3].astype(np.float64).T
    distance = distances(points)
    column = _cells(0.5 - np.arctan2(y, x) / (2 * math.pi), view.width)

    pixel = image_rows(view, scan) * view.width + column

    # Write the points from the farthest to the nearest, so that a pixel keeps the nearest point,
    # and the first of several points that are equally near.
    order = np.argsort(distance, kind="stable")[::-1]
    order = order[distance[order] >= view.nearest]
    image = np.zeros((view.height * view.width, CHANNELS), dtype=np.float32)
    image[pixel[order]] = np.column_stack([points, distance, np.ones_like(distance)])[order]
    return np.ascontiguousarray(image.T).reshape(1, CHANNELS, view.height, view.width), pixel


def scores_of_points(
    view: RangeViewConfig,
    image: np.ndarray,
    pixel: np.ndarray,
    distance: np.ndarray,
    scores: np.ndarray,
) -> np.ndarray:
    """Return the (P, K) scores of points, given scores of pixels, as `RangeImage.to_points` does.

    `image` and `pixel` are what `range_image` returns; `distance` (P,) is in metres, and `scores`
    are (H * W, K) probabilities.
    """
    own: np.ndarray = scores[pixel]
    if not view.hidden:
        return own

    shown, mask = image[0, 4:].reshape(2, -1)
    is_hidden = (np.abs(shown[pixel] - distance) > view.hidden) & (mask[pixel] > 0)
    index = np.flatnonzero(is_hidden)
    row, column = np.divmod(pixel[index], view.width)

    around = OWN_WEIGHT * own[index]
    total = np.full((len(index), 1), OWN_WEIGHT, dtype=np.float32)
    offsets = range(-(WINDOW // 2), WINDOW // 2 + 1)
    for down, right in product(offsets, offsets):
        is_inside = (row + down >= 0) & (row + down < view.height)
        place = np.where(is_inside, row + down, 0) * view.width + (column + right) % view.width
        difference = (shown[place] - distance[index]) / np.float32(view.hidden)
        weight = (np.exp(-(difference**2)) * mask[place] * is_inside)[:, None]
        around += weight * scores[place]
        total += weight
    own[index] = around / total
    return own


def image_rows(view: RangeViewConfig, scan: Scan) -> np.ndarray:
    """Return the (P,) rows of P finite points in the range image; 0 is the top row.

    The scan's own rows take precedence over the rows of the view, as in `RangeView.rows`.

    Raises:
        InputError: if a row is out of range; or if the rows are rings, and a point without a row
            has no ring or one that is out of range.
    """
    unknown = np.full(len(scan), -1)
    own = unknown if scan.row is None else scan.row.astype(np.int64)
    if own.max() >= view.height:
        raise InputError(
            f"expected rows from 0 to {view.height - 1}, found {own.max()}; "
            "normalise the scan for these weights"
        )
    is_unknown = own < 0
    if not is_unknown.any():
        return own
    ring = unknown if scan.ring is None else scan.ring.astype(np.int64)
    if view.rows == "ring":
        _check_rings(ring[is_unknown], view.height)
        return np.where(is_unknown, view.height - 1 - ring, own)

    x, y, z = scan.points[:, :3].astype(np.float64).T
    elevation = np.degrees(np.arctan2(z, np.sqrt(x * x + y * y)))
    rows = _cells((view.fov_up - elevation) / (view.fov_up - view.fov_down), view.height)
    if view.rows == "laser" and view.has_laser_per_row(ring.max()):
        rows = np.where(ring >= 0, view.height - 1 - ring, rows)
    return np.where(is_unknown, rows, own)


def distances(points: np.ndarray) -> np.ndarray:
    """Return the (P,) distances of points (P, 4) from the sensor, metres."""
    xyz = points[:, :3]
    distance: np.ndarray = np.sqrt((xyz * xyz).sum(axis=1))
    return distance


def polar_features(
    view: PolarViewConfig, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (P, 9) float32 features of finite points (P, 4), their pillars, and their voxels."""
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
    """Return the (M,) occupied pillars, ascending, and their maxima (M, C) of features (P, C)."""
    order = np.argsort(pillar, kind="stable")
    occupied, starts = np.unique(pillar[order], return_index=True)
    return occupied, np.maximum.reduceat(features[order], starts, axis=0)


def disagree(assertion: AssertionConfig, f: np.ndarray, g: np.ndarray) -> np.ndarray:
    """Return (P,) bool: whether a point is uncertain, given probabilities f and g, (P, K)."""
    squared_lengths = (f * f).sum(axis=1) * (g * g).sum(axis=1)
    similarity = (f * g).sum(axis=1) / np.sqrt(np.maximum(squared_lengths, TINY))
    uncertain: np.ndarray = np.minimum(similarity, 1) <= assertion.threshold
    return uncertain


def disputed_points(
    assertion: AssertionConfig, f: np.ndarray, g: np.ndarray, uncertain: np.ndarray
) -> np.ndarray:
    """Return (P,) bool: the uncertain points that the head classifies; see `AssertionConfig`."""
    if not assertion.lead:
        return uncertain
    f, g = f[uncertain], g[uncertain]
    differs = f.argmax(axis=1) != g.argmax(axis=1)
    squares = f * g
    is_close = squares * np.float32(assertion.lead**2) >= squares.max(axis=1, keepdims=True)
    disputed = uncertain.copy()
    disputed[uncertain] = differs | (is_close.sum(axis=1) > 1)
    return disputed


def first_in_cubes(
    points: np.ndarray, index: np.ndarray, edge: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the first of some points (U,) in each cube, (V,), and the place (U,) of its cube.

    The cubes divide space, and have an edge in metres; with 0, each point has a cube of its own.
    """
    if not edge:
        return index, np.arange(len(index))
    cubes = np.floor(points[index, :3].astype(np.float64) / edge)
    _, first, cube = np.unique(cubes, axis=0, return_index=True, return_inverse=True)
    return index[first], cube.reshape(-1)


def softmax(scores: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the (P, K) probabilities of logits (P, K)."""
    powers = np.exp(scores - scores.max(axis=1, keepdims=True))
    probabilities: NDArray[np.float32] = powers / powers.sum(axis=1, keepdims=True)
    return probabilities


def _cells(share: NDArray[np.floating], cells: int) -> NDArray[np.int64]:
    """Return which of `cells` equal parts of [0, 1] holds a number, or else is nearest to it."""
    nearest: NDArray[np.int64] = np.clip(np.floor(share * cells).astype(np.int64), 0, cells - 1)
    return nearest


def _check_rings(ring: np.ndarray, height: int) -> None:
    if ring.min() < 0:
        raise InputError(
            "expected a scan with a ring index, found none; use a model with rows by elevation"
        )
    if ring.max() >= height:
        raise InputError(
            f"expected ring indices from 0 to {height - 1}, found {ring.min()} to {ring.max()}; "
            "use a model for this sensor"
        )


def _fill_in(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Spread values (P, ...) of valid points over all points (N, ...). Other points get zeros."""
    filled = np.zeros((len(valid), *values.shape[1:]), dtype=values.dtype)
    filled[valid] = values
    return filled


def read_description(folder: Path) -> dict[str, Any]:
    """Return the description of the graphs in a folder.

    Raises:
        InputError: if there is no description, or it lacks a graph or the classes.
    """
    path = folder / DESCRIPTION
    description = None
    try:
        if path.stat().st_size <= LARGEST_DESCRIPTION:
            description = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        raise InputError(
            f"{folder}: expected {DESCRIPTION} of amvnet export, found none; export again"
        ) from None

    if (
        not isinstance(description, dict)
        or description.get("format") != FORMAT
        or description.get("method") not in list(GRAPHS_BY_METHOD)
    ):
        raise InputError(
            f"{path}: expected format {FORMAT} and a known method, found others; export again"
        )

    graphs = description.get("graphs")
    for name in GRAPHS_BY_METHOD[description["method"]]:
        if not isinstance(graphs, dict) or not _is_complete(graphs.get(name)):
            raise InputError(f"{path}: expected the graph {name}, found none; export again")

    if not isinstance(description.get("classes"), list):
        raise InputError(f"{path}: expected classes, found none; export again")
    return description


def _is_complete(graph: Any) -> bool:
    """Return whether the description of a graph names a file of the folder, and its inputs."""
    if not isinstance(graph, dict) or not isinstance(graph.get("file"), str):
        return False
    if Path(graph["file"]).name != graph["file"] or len(graph["file"]) > LONGEST_NAME:
        return False

    inputs = graph.get("inputs")
    if not isinstance(inputs, list):
        return False
    return all(isinstance(entry, dict) and isinstance(entry.get("name"), str) for entry in inputs)


def read_graph(folder: Path, graph: Mapping[str, Any]) -> bytes:
    """Return the content of a graph's file; raise InputError if it differs from the description."""
    path: Path = folder / graph["file"]
    if not path.is_file():
        raise InputError(f"{path}: expected a graph of amvnet export, found no file; export again")
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(
            f"{path}: expected a graph of amvnet export, found {error.strerror}; export again"
        ) from None

    if hashlib.sha256(content).hexdigest() != graph.get("sha256"):
        raise InputError(
            f"{path}: expected the graph that {DESCRIPTION} describes, found another one (its "
            "sha256 differs); export again"
        )
    return content


def open_session(path: Path, content: bytes, providers: Sequence[str]) -> Any:
    """Open the content of a graph's file in ONNX Runtime; raise InputError if that fails."""
    try:
        import onnxruntime
    except ImportError:
        raise InputError(
            "expected onnxruntime to run the graphs, found none; pip install onnxruntime"
        ) from None

    try:
        return onnxruntime.InferenceSession(content, providers=list(providers))
    except Exception as error:  # because ONNX Runtime's dozen classes have no common base
        raise InputError(
            f"{path}: expected a graph of amvnet export, found: {reason_of(error)}; export again"
        ) from None


def _open_graph(folder: Path, graph: Mapping[str, Any], providers: Sequence[str]) -> Any:
    path = folder / graph["file"]
    session = open_session(path, read_graph(folder, graph), providers)
    inputs = [(value.name, value.shape) for value in session.get_inputs()]
    expected = [(entry.get("name"), entry.get("shape")) for entry in graph["inputs"]]
    if inputs != expected:
        raise InputError(f"{path}: expected the inputs {expected}, found {inputs}; export again")
    return session
