"""The bodies of a simulated street: shapes, labels, and what pulses do to them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lidarstreets import LIDAR_MODELS, SimulatedScan, drive_street
from lidarstreets.bodies import buildings, clutter, fences, furniture, plants, trees
from lidarstreets.materials import Label, Surface
from lidarstreets.mesh import Maker, Mesh, join, place
from lidarstreets.sensing.lidar import Hits, RayScene, trace

from fixtures.examples import first_of

HDL64E = LIDAR_MODELS["hdl64e"]

WITHOUT_CLASS = {Label.OTHER_OBJECT, Label.OTHER_STRUCTURE}
POLE_AND_SIGN = {Label.POLE, Label.TRAFFIC_SIGN, Label.OTHER_OBJECT, Label.OTHER_STRUCTURE}
BUILDING = {Label.BUILDING, Label.VEGETATION}
PLANT = {Label.VEGETATION}
TREE = {Label.VEGETATION, Label.TRUNK, Label.POLE}

MAKERS: dict[str, tuple[Maker, set[Label]]] = {
    "building": (lambda rng: buildings.building(rng, 12, 9, 6, flat=False), BUILDING),
    "tall building": (lambda rng: buildings.building(rng, 20, 12, 16, flat=True), BUILDING),
    "narrow building": (lambda rng: buildings.building(rng, 3, 3, 2, flat=True), BUILDING),
    "shed": (buildings.shed, BUILDING),
    "garages": (lambda rng: buildings.garages(rng, 5), BUILDING),
    "hall": (lambda rng: buildings.hall(rng, 20, 12, 6), BUILDING),
    "greenhouse": (buildings.greenhouse, BUILDING),
    "church": (buildings.church, BUILDING),
    "canopy": (buildings.canopy, BUILDING),
    "barn": (lambda rng: buildings.gable_barn(rng, 10, 14, 4), BUILDING),
    "hedge": (lambda rng: plants.draw_hedge(rng, 1.5).segment(rng, 2.5), PLANT),
    "bush": (lambda rng: plants.bush(rng, 1.0), PLANT),
    "tall grass": (lambda rng: plants.tall_grass(rng, 3.0), PLANT),
    "thicket": (lambda rng: plants.draw_thicket(rng).segment(rng, 4.0, 3.0), TREE),
    "crop row": (lambda rng: plants.crop_row(rng, 5.0, 2.0), PLANT),
    "flower bed": (lambda rng: plants.flower_bed(rng, 3.0), PLANT),
    "leaf heap": (plants.leaf_heap, PLANT),
    "ivy": (lambda rng: plants.ivy(rng, 4.0, 3.0), PLANT),
    "turf": (lambda rng: plants.turf(rng, (5.0, 5.0), 0.2), {Label.TERRAIN}),
    "tree": (lambda rng: trees.random_tree(rng, 8.0), TREE),
    "distant tree": (lambda rng: trees.random_tree(rng, 8.0, fine=False), TREE),
    "stump": (trees.stump, {Label.TRUNK}),
    "copse": (lambda rng: trees.copse(rng, 14.0, 8.0), PLANT),
    "lamp": (furniture.lamp, POLE_AND_SIGN),
    "post": (furniture.post, {Label.POLE}),
    "guide post": (furniture.guide_post, {Label.POLE}),
    "utility pole": (furniture.utility_pole, POLE_AND_SIGN),
    "flag pole": (furniture.flag_pole, POLE_AND_SIGN),
    "sign": (furniture.sign, {Label.POLE, Label.TRAFFIC_SIGN}),
    "direction board": (furniture.direction_board, {Label.POLE, Label.TRAFFIC_SIGN}),
    "traffic light": (furniture.traffic_light, {Label.POLE, Label.TRAFFIC_SIGN}),
    "gantry": (lambda rng: furniture.gantry(rng, 14.0), POLE_AND_SIGN),
    "railway mast": (furniture.railway_mast, {Label.POLE}),
    "clutter": (clutter.clutter, WITHOUT_CLASS | PLANT),
    "yard clutter": (clutter.yard_clutter, WITHOUT_CLASS | PLANT),
    "shelter": (clutter.shelter, WITHOUT_CLASS),
    "steps": (clutter.steps, WITHOUT_CLASS),
    "bridge": (lambda rng: clutter.bridge(rng, 14.0), WITHOUT_CLASS),
}


@pytest.mark.parametrize("seeds", first_of((4, 20)))
@pytest.mark.parametrize("name", MAKERS)
def test_a_body_is_finite_on_the_ground_and_has_labels_of_its_kind(name: str, seeds: int) -> None:
    pytest.importorskip("trimesh")
    make, labels = MAKERS[name]
    for seed in range(seeds):
        mesh = make(np.random.default_rng(seed))
        z = mesh.triangles[..., 2]
        assert np.isfinite(mesh.triangles).all()
        assert np.isfinite(mesh.tint).all()
        assert -1.6 < z.min() < 0.6
        assert 0.1 < z.max() < 30
        assert set(mesh.label.tolist()) <= labels
        assert (mesh.depth >= 0).all()


@pytest.mark.parametrize("kind", fences.FENCE_KINDS)
def test_a_fence_is_as_long_and_high_as_it_says(kind: str) -> None:
    for seed in range(10):
        rng = np.random.default_rng(seed)
        fence = replace(fences.draw_fence(rng, {kind: 1.0}), overgrown=0.0)
        mesh = fence.segment(rng, 2.5)
        low, high = np.quantile(mesh.triangles.reshape(-1, 3), (0, 1), axis=0)
        assert set(mesh.label.tolist()) == {Label.FENCE}
        assert 2.3 < high[0] - low[0] < 3.2
        assert -0.7 < low[2] < 0.3
        # The upper beam of a double guard rail and posts stick out.
        assert 0.7 * fence.height < high[2] < fence.height + 0.6


def test_an_overgrown_fence_has_leaves_and_those_within_it_are_fence() -> None:
    rng = np.random.default_rng(0)
    fence = replace(fences.draw_fence(rng, fences.FENCE_SHARES["garden"]), overgrown=1.0)
    along = 0
    for _ in range(30):
        mesh = fence.segment(rng, 2.5)
        leaves = mesh.surface == Surface.LEAF
        assert leaves.any()

        labels = set(mesh.label[leaves].tolist())
        along += labels == {Label.VEGETATION}
        if labels == {Label.FENCE}:
            corners = mesh.triangles[leaves].reshape(-1, 3)
            assert np.abs(corners[:, 1]).max() < 0.5
            assert corners[:, 2].max() < 1.3 * fence.height
    assert 8 < along < 22


class NoGround:
    def label(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.zeros(len(x), dtype=np.uint16)

    def tint(self, x: np.ndarray, y: np.ndarray, label: np.ndarray) -> np.ndarray:
        return np.zeros(len(x))


def hits_of(mesh: Mesh) -> Hits:
    """Return what the sensor hits of a mesh, which stands across x, 8 m ahead of it."""
    pytest.importorskip("embreex")
    scene = RayScene(place(mesh, 8.0, 0.0, 0.0, np.pi / 2))
    pose = np.eye(4)
    pose[2, 3] = HDL64E.height
    return trace([scene], HDL64E, pose, NoGround(), np.random.default_rng(0))


def row_of(fence: fences.Fence, segments: int = 4) -> Mesh:
    """Return several segments of a fence in a row along x."""
    rng = np.random.default_rng(0)
    pieces = []
    for index in range(segments):
        pieces.append(place(fence.segment(rng, 2.5), 2.5 * index - 3.75, 0, 0, 0))
    return join(*pieces)


def test_a_mesh_fence_lets_more_pulses_through_than_boards() -> None:
    rng = np.random.default_rng(0)
    boards = fences.draw_fence(rng, {"boards": 1.0})
    boards = replace(boards, height=1.4, gap=0.1, overgrown=0.0, lean=0.0)
    mesh = fences.draw_fence(rng, {"mesh": 1.0})
    mesh = replace(mesh, height=1.4, pitch=0.2, gap=0.9, overgrown=0.0, lean=0.0)
    hits_of_boards = len(hits_of(row_of(boards)).label)
    hits_of_mesh = len(hits_of(row_of(mesh)).label)
    assert hits_of_boards > 2000
    assert 0.1 * hits_of_boards < hits_of_mesh < 0.5 * hits_of_boards


def test_a_clipped_hedge_is_fuzzy_by_centimetres() -> None:
    hedge = plants.Hedge("box", 0.8, 1.5, depth=0.03, uneven=0.0, tint=0.0)
    hits = hits_of(hedge.segment(np.random.default_rng(0), 8.0))
    depth = hits.distance * hits.direction[:, 0] - (8.0 - 0.4)
    # The side that faces the sensor, without the pulses that enter through the top.
    depth = depth[(depth > 0) & (depth < 0.3)]
    assert len(depth) > 2000
    assert 0.01 < np.median(depth) < 0.05


@pytest.fixture(scope="module")
def scans() -> list[SimulatedScan]:
    pytest.importorskip("embreex")
    scans: list[SimulatedScan] = []
    for seed in range(8):
        scans += drive_street(HDL64E, 1, np.random.SeedSequence((7, seed)))
    return scans


@pytest.mark.full
def test_a_few_percent_of_the_points_have_no_class(scans: list[SimulatedScan]) -> None:
    ids = np.concatenate([scan.semantickitti_ids() for scan in scans]) & 0xFFFF
    assert 0.01 < np.isin(ids, [0, 1, 52, 99]).mean() < 0.08


@pytest.mark.full
def test_ghosts_are_rare_and_have_no_instance(scans: list[SimulatedScan]) -> None:
    labels = np.concatenate([scan.labels for scan in scans])
    is_ghost = (labels & 0xFFFF) == Label.OUTLIER
    assert 0 < is_ghost.mean() < 0.005
    assert (labels[is_ghost] >> 16 == 0).all()
