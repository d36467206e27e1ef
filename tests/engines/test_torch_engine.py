"""Torch as the engine: what makes it fast changes no label."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from torch.nn import functional as F

import amvnet
from amvnet.data.datasets.open import open_dataset
from amvnet.data.taxonomy import NUSCENES, SEMANTICKITTI, Taxonomy
from amvnet.engines.base import build_model
from amvnet.engines.torch import TorchEngine
from amvnet.inference.segmentation import expand_to_scan
from amvnet.inference.segmenter import Segmenter
from amvnet.models import layers
from amvnet.models.assertion import disputed_points
from amvnet.models.layers import ConvBlock
from amvnet.models.point_head import head_features, point_table
from amvnet.models.polar_net import PolarNet
from amvnet.models.views.points import PointBatch
from amvnet.scan import Scan
from amvnet.weights.file import Weights
from lidarstreets import simulate

from fixtures.engines import scripted, sure_of
from fixtures.sensors import rings_of
from fixtures.tiny import fresh_weights, street

PART = 2000  # uncertain points that the plain model classifies at a time


def test_a_segmenter_labels_what_its_engine_scores() -> None:
    weights = fresh_weights()
    points = street(0, 300)[0]
    points[7] = np.nan
    for column in (0, 5):
        result = scripted(weights, sure_of(weights.taxonomy.size, column))(points)
        assert set(result.labels[result.labels > 0]) == {column + 1}
        assert result.labels[7] == 0
    actual = Segmenter(weights, TorchEngine(weights))(points)
    assert np.array_equal(actual.scores, amvnet.load(weights)(points).scores)


def test_norms_are_folded_for_prediction_and_kernels_keep_their_channels_last() -> None:
    model = build_model(fresh_weights(), "amvnet")
    blocks = [module for module in model.modules() if isinstance(module, ConvBlock)]
    assert len(blocks) > 10
    for convolution, norm, _ in blocks:
        assert isinstance(convolution, torch.nn.Conv2d)
        assert isinstance(norm, torch.nn.Identity)
        assert convolution.weight.is_contiguous(memory_format=torch.channels_last)


# ---- the plain model


def label_plainly(weights: Weights, scan: Scan) -> np.ndarray:
    """Return (N,) train ids by AMVNet without anything that makes it fast.

    The norms are not folded, the U-Net's scores are computed for the whole map, a point looks up
    its voxel among all voxels, and SciPy finds the neighbours.
    """
    model = weights.build()
    batch = PointBatch.of([weights.expects.prepare(scan)])
    f = model.score_range(model.range_view.project(batch))

    net = model.polar_net
    assert isinstance(net, PolarNet)
    grid = model.polar_view.project(batch)
    pillars = net.compress(grid.pool(net.point_mlp(grid.features)))
    decoded = net.unet(grid.to_map(pillars))
    vertical = grid.shape[3]
    voxels = net.scores(decoded)[0].unflatten(0, (vertical, -1)).flatten(2)  # (Z, K, R * A)
    g = voxels[grid.voxel, :, grid.occupied[grid.slot]].softmax(dim=1)

    head = model.point_head
    assert head is not None
    uncertain = model.assertion(f, g, batch.points)
    index = disputed_points(f, g, uncertain, model.lead).nonzero()[:, 0]
    n = head.config.neighbours
    near = torch.from_numpy(nearest_by_scipy(batch.points[:, :3].numpy(), index.numpy(), n))
    table = point_table(batch.points, f, g)
    merged = torch.sqrt(f * g)
    for i, rows in zip(index.split(PART), near.split(PART), strict=True):
        merged[i] = head(*head_features(head.config, table, i, rows)).softmax(dim=1)

    if edge := head.config.cell:
        first: dict[tuple[float, ...], int] = {}
        cubes = np.floor(batch.points[index, :3].double().numpy() / edge)
        for own, cube in zip(index.tolist(), cubes.tolist(), strict=True):
            merged[own] = merged[first.setdefault(tuple(cube), own)]
    return expand_to_scan(merged.argmax(dim=1) + 1, scan.valid)


def nearest_by_scipy(xyz: np.ndarray, own: np.ndarray, n: int) -> np.ndarray:
    """Return (U, n) indices of the nearest other points of the points `own` (U,).

    Of many points in one place, a point may not find itself: then the farthest is dropped.
    """
    tree = cKDTree(xyz, balanced_tree=False, compact_nodes=False)
    nearest = np.asarray(tree.query(xyz[own], k=n + 1)[1])
    rows = [row[row != index][:n] for index, row in zip(own, nearest, strict=True)]
    return np.array(rows)


def weights_and_data() -> list[tuple[str, str]]:
    """Return weights and datasets to compare with: simulated, and real ones if there are any."""
    pairs = [("sim-hdl64e", "simulated:hdl64e"), ("sim-hdl32e", "simulated:hdl32e")]
    real = os.environ.get("AMVNET_REAL_DATA")
    if real:
        pairs.append(("sim-hdl64e", f"semantickitti:{real}/semantickitti"))
        pairs.append(("sim-hdl32e", f"nuscenes:{real}/nuscenes"))
    return pairs


def share_of_equal_labels(weights: str | Weights, scan: Scan) -> float:
    """Return how many labels of a scan are those of the plain model."""
    segmenter = amvnet.load(weights)
    # With gradients, layers take their plain ways.
    with torch.enable_grad(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(layers, "linear", F.linear)
        expected = label_plainly(segmenter.weights, scan)
    return float((segmenter(scan).labels == expected).mean())


@pytest.mark.parametrize("taxonomy", [SEMANTICKITTI, NUSCENES], ids=lambda each: each.name)
def test_what_makes_a_small_model_fast_leaves_the_labels_as_they_are(taxonomy: Taxonomy) -> None:
    points = street(0, 4000)[0]
    scan = Scan(points, ring=rings_of(points, 32))
    assert share_of_equal_labels(fresh_weights(taxonomy), scan) >= 0.9999


@pytest.mark.full
@pytest.mark.parametrize(("weights", "data"), weights_and_data())
def test_what_makes_it_fast_leaves_the_labels(tmp_path: Path, weights: str, data: str) -> None:
    if data.startswith("simulated:"):
        pytest.importorskip("embreex")
        sensor = data.removeprefix("simulated:")
        simulate(tmp_path, sensor=sensor, scans=2, sequences=1, seed=7)
        layout = "semantickitti" if sensor == "hdl64e" else "nuscenes"
        data = f"{layout}:{tmp_path}"
        step = 4
    else:
        step = 20 if data.startswith("semantickitti:") else 4
    dataset = open_dataset(data)
    records = dataset.records(dataset.sequences("all"))[::step][:4]
    equal = []
    for record in records:
        equal.append(share_of_equal_labels(weights, dataset.read(record, labels=False)))
    assert equal
    assert np.mean(equal) >= 0.9999
