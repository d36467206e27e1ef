"""An ensemble of heads averages their probabilities; a single head is as it was."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import nn

from amvnet.config.schema import PointHeadConfig
from amvnet.models.amvnet import build_amvnet
from amvnet.models.head_ensemble import HeadEnsemble, build_head, heads_of
from amvnet.models.point_head import PointHead, head_features
from amvnet.models.views.points import PointBatch
from amvnet.scan import Scan

from fixtures.networks import TINY, K, trained_head
from fixtures.worlds import fails


def softmax_by_loop(logits: list[float]) -> list[float]:
    total = sum(math.exp(value) for value in logits)
    return [math.exp(value) / total for value in logits]


def test_the_probabilities_of_an_ensemble_are_the_mean_of_its_heads() -> None:
    ensemble = trained_head(replace(TINY.point_head, heads=3), K)
    assert isinstance(ensemble, HeadEnsemble)
    point = 3 * torch.randn(10, 2 * K + 4)
    rows = 3 * torch.randn(10, 3, 2 * K + 4)

    with torch.no_grad():
        probabilities = ensemble(point, rows).softmax(dim=1)
        logits = [head(point, rows).tolist() for head in heads_of(ensemble)]
    for i in range(10):
        by_head = [softmax_by_loop(of_head[i]) for of_head in logits]
        for k in range(K):
            mean = sum(of_head[k] for of_head in by_head) / 3
            assert probabilities[i, k].item() == pytest.approx(mean, abs=1e-6)
    assert logits[0] != logits[1] != logits[2]  # each has weights of its own


def test_a_scan_gets_the_mean_of_what_the_heads_say_of_it_alone() -> None:
    torch.manual_seed(0)
    config = replace(TINY, point_head=replace(TINY.point_head, heads=2, pooling="attention"))
    model = build_amvnet(config, K).eval()
    model.assertion = lambda f, g, points, labels=None: points[:, 3] > 0.5
    ensemble = model.point_head
    assert isinstance(ensemble, HeadEnsemble)
    points = torch.cat([10 * torch.randn(40, 3), torch.rand(40, 1)], dim=1)
    batch = PointBatch.of([Scan(points.numpy())])

    with torch.inference_mode():
        together = model(batch)
        alone = []
        for head in heads_of(ensemble):
            model.point_head = head
            alone.append(model(batch).merged)
    uncertain = together.uncertain
    assert 0 < uncertain.sum() < 40
    mean = (alone[0] + alone[1]) / 2
    torch.testing.assert_close(together.merged[uncertain], mean[uncertain])
    torch.testing.assert_close(together.merged[~uncertain], alone[0][~uncertain])


def test_an_ensemble_survives_certainty() -> None:
    ensemble = trained_head(replace(TINY.point_head, heads=2), K)
    for head in heads_of(ensemble):
        last = head.fc[-1]
        assert isinstance(last, nn.Linear)
        nn.init.constant_(last.weight, 1e3)
    with torch.no_grad():
        logits = ensemble(torch.randn(10, 2 * K + 4), torch.randn(10, 3, 2 * K + 4))
    assert torch.isfinite(logits.softmax(dim=1)).all()


def test_a_single_head_has_the_parameters_that_it_always_had() -> None:
    head = build_head(PointHeadConfig(), 19)
    assert isinstance(head, PointHead)
    linear = ("weight", "bias")
    norm = (*linear, "running_mean", "running_var", "num_batches_tracked")
    names = []
    for place in ("mlp.0", "mlp.1", "mlp.3", "mlp.4", "mlp.6", "mlp.7", "fc.0.0", "fc.0.1", "fc.1"):
        is_norm = place in ("mlp.1", "mlp.4", "mlp.7", "fc.0.1")
        names += [f"{place}.{name}" for name in (norm if is_norm else linear)]
    assert list(head.state_dict()) == names


def test_many_wide_heads_are_refused() -> None:
    assert PointHeadConfig(heads=16).heads == 16
    fails(lambda: PointHeadConfig(heads=17), "heads", "16")
    fails(lambda: PointHeadConfig(heads=16, hidden=(1024,)), "all heads together", "16384")


@pytest.mark.parametrize("share", [0.25, 0.5])
def test_a_share_is_the_weight_of_the_head_in_a_mean_with_the_ensemble(share: float) -> None:
    alone = trained_head(TINY.point_head, K)
    shared = trained_head(replace(TINY.point_head, share=share), K)
    f = torch.randn(12, K).softmax(dim=1)
    g = (3 * torch.randn(12, K)).softmax(dim=1)
    points = torch.randn(12, 4)
    table = torch.cat([f, g, points], dim=1)
    uncertain = torch.tensor([2, 5, 11])
    near = torch.randint(0, 12, (3, TINY.point_head.neighbours))

    with torch.no_grad():
        h = alone.score(table, uncertain, near).softmax(dim=1)
        fast = shared.score(table, uncertain, near).softmax(dim=1)
        plain = shared(*head_features(shared.config, table, uncertain, near)).softmax(dim=1)
    for row, i in enumerate(uncertain.tolist()):
        weighted = []
        for k in range(K):
            ensemble = math.sqrt(f[i, k].item() * g[i, k].item())
            weighted.append(h[row, k].item() ** share * ensemble ** (1 - share))
        for k in range(K):
            expected = weighted[k] / sum(weighted)
            assert fast[row, k].item() == pytest.approx(expected, abs=1e-5)
            assert plain[row, k].item() == pytest.approx(expected, abs=1e-5)


def test_a_head_learns_alone_whatever_its_share() -> None:
    point = torch.rand(10, 2 * K + 4)
    rows = torch.rand(10, TINY.point_head.neighbours, 2 * K + 4)
    logits = []
    for share in (1.0, 0.5):
        head = trained_head(replace(TINY.point_head, share=share), K).train()
        logits.append(head(point, rows))
    assert torch.equal(*logits)


def test_a_share_survives_probabilities_of_zero() -> None:
    head = trained_head(replace(TINY.point_head, share=0.5), K)
    point = torch.zeros(1, 2 * K + 4)
    point[0, [1, K + 2]] = 1  # the networks are sure, of different classes
    with torch.no_grad():
        logits = head(point, torch.zeros(1, TINY.point_head.neighbours, 2 * K + 4))
    assert logits.isfinite().all()
