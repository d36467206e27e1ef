"""The point head, the assertions, the merge and all of AMVNet equal loops over their formulas."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from amvnet.config.schema import PointHeadConfig
from amvnet.models import neighbours
from amvnet.models import point_head as point_head_module
from amvnet.models.assertion import Disagreement, disputed_points
from amvnet.models.layers import freeze
from amvnet.models.methods import arithmetic_mean, geometric_mean, maximum
from amvnet.models.neighbours import Query
from amvnet.models.point_head import head_features, nearest_neighbours, point_table
from amvnet.models.views.points import PointBatch
from amvnet.models.views.polar_view import PolarGrid
from amvnet.scan import Scan

from fixtures.commands import not_none
from fixtures.networks import GRID, TINY, K, trained_head, whole_model

RandomScan = Callable[..., Scan]


def test_the_papers_point_head_has_18500_parameters_and_costs_one_gmac_for_10000_points() -> None:
    head = trained_head(PointHeadConfig(), 19)
    assert sum(p.numel() for p in head.parameters()) == pytest.approx(18_500, abs=100)

    width = 2 * 19 + 4
    with FlopCounterMode(display=False) as counter:
        logits = head(torch.zeros(500, width), torch.zeros(500, 15, width))
    assert logits.shape == (500, 19)
    assert counter.get_total_flops() / 2 * (10_000 / 500) == pytest.approx(1e9, rel=0.05)


def test_the_point_head_depends_on_its_neighbours_but_not_on_their_order() -> None:
    head = trained_head(TINY.point_head, K)
    point = torch.randn(5, 2 * K + 4)
    rows = torch.randn(5, 3, 2 * K + 4)
    expected = head(point, rows)

    for order in permutations(range(3)):
        torch.testing.assert_close(head(point, rows[:, order]), expected)

    for neighbour in range(3):
        changed = rows.clone()
        changed[:, neighbour] += 10
        assert (head(point, changed) != expected).any()
    assert (head(point + 1, rows) != expected).any(dim=1).all()


def test_folded_batch_norms_change_no_output_of_the_point_head() -> None:
    torch.manual_seed(0)
    head = trained_head(TINY.point_head, K)
    point = torch.randn(20, 2 * K + 4)
    rows = torch.randn(20, 3, 2 * K + 4)
    head.train()(point, rows)  # changes the norms' initial statistics
    before = head.eval()(point, rows)

    freeze(head)
    torch.testing.assert_close(head(point, rows), before, rtol=1e-4, atol=1e-5)
    assert not any(isinstance(m, nn.BatchNorm1d) for m in head.modules())


def neighbours_by_loop(points: Tensor, own: int) -> tuple[list[int], list[float]]:
    """Return the other points' indices, nearest first, and the distance of every point."""
    xyz = points[:, :3].tolist()
    distances = [math.dist(position, xyz[own]) for position in xyz]
    nearest = sorted(range(len(xyz)), key=distances.__getitem__)
    nearest.remove(own)
    return nearest, distances


@pytest.fixture(params=["pykdtree", "scipy", "by parts"])
def tree(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Search for neighbours by each of the two libraries, and of a few points at a time."""
    if request.param == "by parts":
        monkeypatch.setattr("amvnet.models.neighbours.QUERIES_AT_ONCE", 3)
    if request.param == "scipy":
        monkeypatch.setitem(sys.modules, "pykdtree.kdtree", None)  # as if it were not installed


@pytest.mark.parametrize("n", [1, 3, 12])
@pytest.mark.parametrize("places", [1, 4, 20, 40])
@pytest.mark.parametrize("crowd", [1, 256])
@pytest.mark.usefixtures("tree")
def test_neighbours_are_different_others_as_near_as_in_a_search_through_all_points(
    crowd: int, places: int, n: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(neighbours, "CROWD", crowd)
    positions = torch.randn(places, 4, generator=torch.Generator().manual_seed(0))
    points = positions[torch.arange(40) % places]
    for own, row in enumerate(nearest_neighbours(points, torch.arange(40), n).tolist()):
        assert own not in row
        assert len(set(row)) == n

        expected, distances = neighbours_by_loop(points, own)
        for index, as_near in zip(row, expected[:n], strict=True):
            assert distances[index] == distances[as_near]


def test_no_library_chooses_among_equally_near_points(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else labels would: real scans hold many points twice."""
    places = torch.randn(100, 4, generator=torch.Generator().manual_seed(0))
    points = places[torch.arange(300) % 100]  # with 15 neighbours, the last is one of several
    index = torch.arange(300)
    by_pykdtree = nearest_neighbours(points, index, 15)
    monkeypatch.setitem(sys.modules, "pykdtree.kdtree", None)
    assert torch.equal(nearest_neighbours(points, index, 15), by_pykdtree)


@pytest.mark.parametrize("is_crowded", [True, False])
@pytest.mark.usefixtures("tree")
def test_a_search_gets_few_points_and_few_queries_of_one_place(
    is_crowded: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A tree goes through all points in one place, once for each query there."""
    points = torch.randn(900, 4, generator=torch.Generator().manual_seed(0))
    if is_crowded:
        points[50::2, :3] = 0.0
        points[51::2, :3] = -0.0  # the same place
    searched: list[np.ndarray] = []
    queried: list[list[float]] = []

    def recorded(make_query: Callable[..., Query]) -> Callable[..., Query]:
        def make_recorded(xyz: np.ndarray, m: int) -> Query:
            query = make_query(xyz, m)
            searched.append(xyz)

            def record(queries: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
                queried.extend(queries.tolist())
                return query(queries)

            return record

        return make_recorded

    for name in ("_query_by_pykdtree", "_query_by_scipy"):
        monkeypatch.setattr(neighbours, name, recorded(getattr(neighbours, name)))
    nearest_neighbours(points, torch.arange(900), 3)

    kept = 50 + neighbours.CROWD if is_crowded else 900
    assert {len(xyz) for xyz in searched} == {kept}
    assert kept <= len(queried) <= 2 * kept


@pytest.mark.usefixtures("tree")
def test_with_fewer_points_than_neighbours_the_last_one_is_repeated() -> None:
    points = torch.tensor([[0.0, 0, 0, 9], [5, 0, 0, 9], [1, 0, 0, 9], [3, 0, 0, 9]])
    assert nearest_neighbours(points, torch.tensor([0, 1]), 6).tolist() == [
        [2, 3, 1, 1, 1, 1],
        [3, 2, 0, 0, 0, 0],
    ]
    assert nearest_neighbours(torch.ones(1, 4), torch.tensor([0]), 3).tolist() == [[0, 0, 0]]


@pytest.mark.parametrize("points", [0, 5])
def test_without_an_uncertain_point_there_are_no_neighbours(points: int) -> None:
    nearest = nearest_neighbours(torch.randn(points, 4), torch.zeros(0, dtype=torch.long), 3)
    assert (nearest.shape, nearest.dtype) == ((0, 3), torch.int32)


def head_features_by_loop(
    points: Tensor, f: Tensor, g: Tensor, own: int
) -> tuple[list[float], list[list[float]]]:
    """Return p_i and S_i of a point, with the configuration of `TINY`."""
    x, y, z, intensity = points[own].tolist()
    scale = TINY.point_head.position_scale
    point = [*f[own].tolist(), *g[own].tolist(), x * scale, y * scale, z * scale, intensity]

    nearest, _ = neighbours_by_loop(points, own)
    rows = [
        [*f[k].tolist(), *g[k].tolist(), *(points[k] - points[own]).tolist()]
        for k in nearest[: TINY.point_head.neighbours]
    ]
    return point, rows


def random_scores(count: int = 200) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Draw two (P, K) probabilities, (P, 4) points and (P,) labels, some of them 0."""
    torch.manual_seed(0)
    f, g = (torch.randn(2, count, K) * 2).softmax(dim=2)
    return f, g, torch.randn(count, 4), torch.randint(0, K + 1, (count,))


def cosine(a: list[float], b: list[float]) -> float:
    product = 0.0
    for x, y in zip(a, b, strict=True):
        product += x * y
    return product / (math.hypot(*a) * math.hypot(*b))


def test_disagreement_equals_a_loop_of_its_formula() -> None:
    f, g, points, _ = random_scores()
    expected = [cosine(f[i].tolist(), g[i].tolist()) <= 0.7 for i in range(len(f))]

    assert Disagreement(0.7)(f, g, points).tolist() == expected
    assert set(expected) == {False, True}

    # At the threshold a point is uncertain, and at 1 all are, whatever rounding does.
    f = torch.eye(2)
    assert Disagreement(0.0)(f, f.flip(0), torch.zeros(2, 4)).all()
    f = torch.rand(10_000, K).softmax(1)
    assert Disagreement(1.0)(f, f, torch.zeros(10_000, 4)).all()


@pytest.mark.parametrize("edge", [0.0, 0.1, 1.0])
def test_points_of_a_cube_get_the_scores_of_its_first_disputed_point(edge: float) -> None:
    f, g, points, _ = random_scores()
    points[::50, :3] *= 100  # some are far away
    batch = PointBatch.of([Scan(points.numpy()), Scan(points[:70].flip(0).numpy())])
    f, g = (torch.cat([values, values[:70].flip(0)]) for values in (f, g))
    disputed = torch.arange(270) % 3 > 0
    model = whole_model().eval()
    h = not_none(model.refine(batch, f, g, disputed))
    every = torch.zeros_like(f)
    every[disputed] = h

    not_none(model.point_head).config = replace(TINY.point_head, cell=edge)
    shared = model.refine(batch, f, g, disputed)
    first: dict[tuple[int, ...], int] = {}
    expected = []
    for i in disputed.nonzero()[:, 0].tolist():
        place = [math.floor(x / edge) if edge else i for x in batch.points[i, :3].tolist()]
        expected.append(every[first.setdefault((i >= 200, *place), i)])
    assert shared is not None
    torch.testing.assert_close(shared, torch.stack(expected))
    assert (len(first) < len(expected)) == (edge == 1)


def test_disputed_points_equal_a_loop_over_the_uncertain_ones() -> None:
    f, g, points, _ = random_scores()
    uncertain = Disagreement(0.95)(f, g, points)
    expected = []
    for i in range(len(f)):
        best, second = sorted(math.sqrt(a * b) for a, b in zip(f[i], g[i], strict=True))[:-3:-1]
        differs = bool(f[i].argmax() != g[i].argmax())
        expected.append(bool(uncertain[i]) and (differs or best <= 2 * second))

    assert disputed_points(f, g, uncertain, 2).tolist() == expected
    assert disputed_points(f, g, uncertain, 1.0).sum() < sum(expected)
    assert 0 < sum(expected) < uncertain.sum()
    assert disputed_points(f, g, uncertain, 0.0).equal(uncertain)
    assert not disputed_points(f, g, torch.zeros(len(f), dtype=torch.bool), 2.0).any()


def test_the_head_gets_disputed_points_and_uncertain_stay(random_scan: RandomScan) -> None:
    model = whole_model()
    batch = PointBatch.of([random_scan(40), random_scan(30)])
    paper = model(batch)
    model.lead = 1.5
    scores = model(batch)

    assert scores.uncertain.equal(paper.uncertain)
    disputed = disputed_points(scores.rv, scores.bev, scores.uncertain, 1.5)
    assert 0 < disputed.sum() < scores.uncertain.sum()
    torch.testing.assert_close(scores.merged[disputed], paper.merged[disputed])
    mean = geometric_mean(scores.rv, scores.bev)
    torch.testing.assert_close(scores.merged[~disputed], mean[~disputed])
    assert (scores.merged != paper.merged).any()


def test_another_assertion_can_be_written_as_the_page_shows() -> None:
    page = Path(__file__).parents[2] / "docs/options.md"
    (example,) = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.S)
    scope: dict[str, Any] = {}
    exec(example, scope)

    f, g, points, _ = random_scores()
    expected = []
    for i in range(len(f)):
        mean = [(f[i, k].item() + g[i, k].item()) / 2 for k in range(K)]
        expected.append(-sum(p * math.log(p) for p in mean) >= 0.9)
    assert scope["HighEntropy"](0.9)(f, g, points).tolist() == expected
    assert set(expected) == {False, True}
    assert scope["segmenter"].model.assertion == scope["HighEntropy"](0.7)


def test_the_ensembles_equal_their_formulas() -> None:
    f, g, _, _ = random_scores(20)
    for i in range(20):
        for k in range(K):
            a = f[i, k].item()
            b = g[i, k].item()
            assert geometric_mean(f, g)[i, k].item() == pytest.approx(math.sqrt(a * b), rel=1e-6)
            assert arithmetic_mean(f, g)[i, k].item() == pytest.approx((a + b) / 2, rel=1e-6)
            assert maximum(f, g)[i, k].item() == max(a, b)


class Constant(nn.Module):
    """A stand-in for a network, with the same logits for each pixel or voxel."""

    def __init__(self, *scores: float) -> None:
        super().__init__()
        self.scores = torch.tensor(scores)

    def forward(self, view: Tensor | PolarGrid) -> Tensor:
        if isinstance(view, Tensor):
            return self.scores[:, None, None].expand(1, K, 7, 21)
        return self.scores.repeat(len(view.occupied), GRID.vertical)


def test_agreement_leaves_the_scores_alone(random_scan: RandomScan) -> None:
    model = whole_model()
    model.assertion = Disagreement()
    model.range_net = Constant(1, 0, 2, -1)
    model.polar_net = Constant(1, 0, 2, -1)
    scores = model(PointBatch.of([random_scan(30)]))
    assert not scores.uncertain.any()
    torch.testing.assert_close(scores.merged, scores.rv)
    torch.testing.assert_close(scores.rv[0], torch.tensor([1.0, 0, 2, -1]).softmax(0))

    model.polar_net = Constant(1, 0, -2, -1)
    assert model(PointBatch.of([random_scan(30)])).uncertain.all()


@pytest.mark.parametrize("uncertain", [0, 1, 2500])
@pytest.mark.parametrize("folded", [False, True])
def test_scores_from_the_table_are_those_of_features(uncertain: int, folded: bool) -> None:
    head = trained_head(PointHeadConfig(), 19)
    if folded:
        freeze(head)

    points = torch.cat([20 * torch.randn(3000, 3), torch.rand(3000, 1)], dim=1)
    f, g = (3 * torch.randn(2, 3000, 19)).softmax(dim=2)
    table = point_table(points, f, g)
    index = torch.randperm(3000)[:uncertain]
    near = torch.randint(3000, (uncertain, 15))

    expected = head(*head_features(head.config, table, index, near))
    torch.testing.assert_close(head.score(table, index, near), expected, rtol=1e-4, atol=1e-5)


def test_a_scan_of_many_uncertain_points_is_classified_by_sectors_with_the_same_result(
    random_scan: RandomScan, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = whole_model()
    model.point_head = trained_head(TINY.point_head, K)
    batch = PointBatch.of([random_scan(500)])
    f, g = torch.rand(2, 500, K).softmax(dim=2)
    uncertain = torch.rand(500) < 0.7
    with torch.inference_mode():
        expected = model.refine(batch, f, g, uncertain)

        classified: list[int] = []
        score = model.point_head.score

        def counted(table: Tensor, uncertain: Tensor, near: Tensor) -> Tensor:
            classified.append(len(uncertain))
            return score(table, uncertain, near)

        monkeypatch.setattr(model.point_head, "score", counted)
        monkeypatch.setattr(point_head_module, "POINTS_AT_ONCE", 64)
        h = model.refine(batch, f, g, uncertain)

    assert (max(classified), sum(classified)) == (64, uncertain.sum())
    torch.testing.assert_close(h, expected)


@pytest.mark.parametrize("brightest", [0, 1, 5])
def test_uncertain_points_alone_get_the_head(random_scan: RandomScan, brightest: int) -> None:
    batch = PointBatch.of([random_scan(30)])
    intensity = batch.points[:, 3].sort(descending=True).values
    model = whole_model(dull=intensity[brightest].item())
    assert model.point_head is not None
    scores = model(batch)
    assert scores.uncertain.sum() == brightest

    for i in range(30):
        expected = torch.sqrt(scores.rv[i] * scores.bev[i])
        if scores.uncertain[i]:
            point, rows = head_features_by_loop(batch.points, scores.rv, scores.bev, i)
            expected = model.point_head(torch.tensor([point]), torch.tensor([rows]))[0].softmax(0)
        torch.testing.assert_close(scores.merged[i], expected, rtol=1e-4, atol=1e-5)


def test_scores_are_those_of_each_points_pixel_and_voxel(random_scan: RandomScan) -> None:
    model = whole_model()
    batch = PointBatch.of([random_scan(30)])
    scores = model(batch)
    image = model.range_view.project(batch)
    grid = model.polar_view.project(batch)
    pixels = model.range_net(image.image)[0].flatten(1)
    voxels = grid.to_map(model.polar_net(grid))[0].flatten(1)

    for i in range(30):
        torch.testing.assert_close(scores.rv[i], pixels[:, image.pixel[i]].softmax(0))
        first = int(grid.voxel[i]) * K
        expected = voxels[first : first + K, grid.occupied[grid.slot][i]].softmax(0)
        torch.testing.assert_close(scores.bev[i], expected)


@pytest.mark.parametrize("counts", [(40, 30), (40, 1), (2, 40), (40, 0, 3)])
def test_a_batch_equals_each_scan_alone(random_scan: RandomScan, counts: tuple[int, ...]) -> None:
    model = whole_model()
    scans = [random_scan(count, seed) for seed, count in enumerate(counts)]
    batch = PointBatch.of(scans)
    together = model(batch)
    assert together.uncertain.any()

    for scan, rows in zip(scans, batch.slices, strict=True):
        alone = model(PointBatch.of([scan]))
        for name in ("rv", "bev", "merged", "uncertain"):
            values = getattr(together, name)[rows]
            torch.testing.assert_close(values, getattr(alone, name), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_scans_of_fewer_points_than_neighbours_score(random_scan: RandomScan, count: int) -> None:
    scores = whole_model(dull=-1.0)(PointBatch.of([random_scan(count)]))
    assert scores.uncertain.sum() == count
    torch.testing.assert_close(scores.merged.sum(dim=1), torch.ones(count))
