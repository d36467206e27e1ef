"""The losses equal plain loops over their definitions, and leave ignored points out."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from amvnet.training.losses import (
    FREQUENCY_FLOOR,
    RegionLoss,
    Scored,
    Targets,
    class_weights,
    dice,
    distillation_loss,
    lovasz_softmax,
    majority_labels,
    network_loss,
    rival_classes,
)

from fixtures.commands import not_none

K = 5
LOSSES = pytest.mark.parametrize("region_loss", [dice, lovasz_softmax])


def loss_of(
    region_loss: RegionLoss,
    logits: Tensor,
    labels: Tensor,
    weights: Tensor | None = None,
    region: float = 1.0,
) -> Tensor:
    scored = Scored(logits, labels, torch.zeros(len(labels), dtype=torch.long), scans=1)
    return network_loss(scored, weights, region, region_loss)


def region_of(region_loss: RegionLoss, probabilities: Tensor, target: Tensor) -> Tensor:
    scan = torch.zeros_like(target)
    return region_loss(probabilities, Targets.of(target, scan, (1, probabilities.shape[1])))


def example(points: int = 60, seed: int = 0, classes: int = K) -> tuple[Tensor, Tensor]:
    """Make (P, K) logits and (P,) labels; some labels are 0, and the last class is absent."""
    generator = torch.Generator().manual_seed(seed)
    logits = torch.randn(points, classes, generator=generator) * 2
    return logits, torch.randint(0, classes, (points,), generator=generator)


def cross_entropy_by_loop(logits: Tensor, labels: Tensor, weights: list[float]) -> float:
    total = 0.0
    total_weight = 0.0
    for row, label in zip(logits.double().tolist(), labels.tolist(), strict=True):
        if label == 0:
            continue
        exponentials = [math.exp(logit) for logit in row]
        total -= weights[label - 1] * math.log(exponentials[label - 1] / sum(exponentials))
        total_weight += weights[label - 1]
    return total / total_weight


def dice_by_loop(probabilities: list[list[float]], target: list[int]) -> float:
    scores = []
    for index in set(target):
        overlap = 0.0
        size = float(target.count(index))
        for row, truth in zip(probabilities, target, strict=True):
            size += row[index]
            if truth == index:
                overlap += row[index]
        scores.append(2 * overlap / size)
    return 1 - sum(scores) / len(scores)


def jaccard_loss(wrong: set[int], members: set[int]) -> float:
    """Return 1 - |truth and prediction| / |truth or prediction| of a class.

    Args:
        wrong: indices of the points that are mispredicted.
        members: indices of the points of the class.
    """
    prediction = members ^ wrong
    return 1 - len(members & prediction) / len(members | prediction)


def lovasz_by_sets(probabilities: list[list[float]], target: list[int]) -> float:
    """Return the Lovász extension by its definition.

    The errors are taken from the largest to the smallest; each is weighted by the increase of the
    Jaccard loss if its point is mispredicted, too.
    """
    losses = []
    for index in set(target):
        members = {point for point, truth in enumerate(target) if truth == index}
        errors = {point: row[index] for point, row in enumerate(probabilities)}
        for point in members:
            errors[point] = 1 - errors[point]

        wrong: set[int] = set()
        loss = 0.0
        for point in sorted(errors, key=errors.__getitem__, reverse=True):
            before = jaccard_loss(wrong, members)
            wrong.add(point)
            loss += errors[point] * (jaccard_loss(wrong, members) - before)
        losses.append(loss)
    return sum(losses) / len(losses)


@LOSSES
@pytest.mark.parametrize("weights", [None, [1.0, 0.2, 3.0, 0.7, 2.0]])
def test_without_the_region_loss_a_loss_is_weighted_cross_entropy(
    region_loss: RegionLoss, weights: list[float] | None
) -> None:
    logits, labels = example()
    tensor = None if weights is None else torch.tensor(weights)
    assert loss_of(region_loss, logits, labels, tensor, 0.0).item() == pytest.approx(
        cross_entropy_by_loop(logits, labels, weights or [1.0] * K), rel=1e-5
    )


@LOSSES
def test_a_loss_is_cross_entropy_plus_the_weighted_region_loss(region_loss: RegionLoss) -> None:
    logits, labels = example()
    labelled = labels > 0
    region = region_of(region_loss, logits[labelled].softmax(dim=1), labels[labelled] - 1)
    expected = loss_of(region_loss, logits, labels, None, 0.0) + 1.5 * region
    torch.testing.assert_close(loss_of(region_loss, logits, labels, None, 1.5), expected)


@LOSSES
def test_a_batchs_loss_and_gradient_are_the_means_over_its_scans(region_loss: RegionLoss) -> None:
    """One of the scans has no label, and the points of the scans are mixed."""
    logits, labels = example(points=400, classes=9)
    scan = torch.randint(0, 4, (400,), generator=torch.Generator().manual_seed(1))
    labels[scan == 2] = 0
    weights = torch.rand(9) + 0.1
    logits.requires_grad_()

    batch = network_loss(Scored(logits, labels, scan, scans=4), weights, 0.7, region_loss)
    (gradient,) = torch.autograd.grad(batch, logits)
    scans = []
    for number in range(4):
        of_scan = scan == number
        scans.append(loss_of(region_loss, logits[of_scan], labels[of_scan], weights, 0.7))
    mean = torch.stack(scans).mean()
    (expected,) = torch.autograd.grad(mean, logits)
    assert scans[2] == 0
    torch.testing.assert_close(batch, mean)
    torch.testing.assert_close(gradient, expected)


def test_a_class_that_one_dataset_lacks_has_no_rivals_there() -> None:
    present = np.array([[1, 0, 0, 1], [1, 1, 0, 0]], bool)
    rivals = not_none(rival_classes(present))
    # No dataset has the third class, so that all points count against it.
    assert rivals.tolist() == [[True, False, True, True], [True, True, True, False]]
    assert rival_classes(present[:1]) is None
    assert rival_classes(np.ones((2, 4), bool)) is None


@LOSSES
def test_points_of_a_dataset_ignore_the_classes_that_it_lacks(region_loss: RegionLoss) -> None:
    """The loss of a scan equals the loss without the columns of these classes."""
    logits, labels = example(points=200, classes=7)
    labels[labels == 2] = 1  # the dataset lacks the classes 2 and 5
    labels[labels == 5] = 4
    kept = torch.tensor([0, 2, 3, 5, 6])
    weights = torch.rand(7) + 0.1
    scan = torch.zeros(200, dtype=torch.long)
    rivals = torch.ones(2, 7, dtype=torch.bool)
    rivals[1, [1, 4]] = False
    logits.requires_grad_()

    scored = Scored(logits, labels, scan, scans=1, source=torch.ones_like(scan))
    loss = network_loss(scored, weights, 0.7, region_loss, rivals)
    position = torch.zeros(8, dtype=torch.long)
    position[kept + 1] = torch.arange(1, 6)
    expected = loss_of(region_loss, logits[:, kept], position[labels], weights[kept], 0.7)
    torch.testing.assert_close(loss, expected)
    (gradient,) = torch.autograd.grad(loss, logits)
    (of_kept,) = torch.autograd.grad(expected, logits)
    torch.testing.assert_close(gradient, of_kept)

    # With points of the other dataset, nothing changes.
    other = Scored(logits, labels, scan, scans=1, source=scan)
    torch.testing.assert_close(
        network_loss(other, weights, 0.7, region_loss, rivals),
        loss_of(region_loss, logits, labels, weights, 0.7),
    )


@LOSSES
def test_a_point_of_a_class_its_dataset_lacks_has_finite_loss(region_loss: RegionLoss) -> None:
    """Such as a voxel that has points of two datasets."""
    logits, labels = example(points=50)
    scan = torch.zeros(50, dtype=torch.long)
    scored = Scored(logits.requires_grad_(), labels, scan, scans=1, source=scan)
    loss = network_loss(scored, None, 1, region_loss, torch.zeros(1, K, dtype=torch.bool))
    (gradient,) = torch.autograd.grad(loss, logits)
    assert loss.isfinite()
    assert gradient.isfinite().all()


def test_a_distillation_is_the_cross_entropy_of_the_classes_left_out_and_the_others() -> None:
    """The mean over scans of the mean over their labelled points, in a plain loop."""
    logits, labels = example(points=90, classes=6)
    teacher, _ = example(points=90, classes=6, seed=1)
    labels[:5] = 3  # a class that dataset 1 lacks, as in a voxel with points of two datasets
    scan = torch.arange(90) % 3
    source = (torch.arange(90) % 6 < 4).long()
    rivals = torch.ones(2, 6, dtype=torch.bool)
    left_out = [2, 4]
    rivals[1, left_out] = False
    scored = Scored(logits.requires_grad_(), labels, scan, scans=3, source=source)

    scans = []
    for number in range(3):
        losses = []
        for p in range(90):
            label = int(labels[p])
            if scan[p] != number or source[p] == 0 or label == 0 or label - 1 in left_out:
                continue
            student, target = logits[p].softmax(0), teacher[p].softmax(0)
            rest, target_rest = 1 - student[left_out].sum(), 1 - target[left_out].sum()
            loss = -(target[left_out] * student[left_out].log()).sum()
            losses.append(loss - target_rest * rest.log())
        scans.append(torch.stack(losses).mean() if losses else torch.zeros(()))
    loss = distillation_loss(scored, teacher, rivals)
    torch.testing.assert_close(loss, torch.stack(scans).mean())


def test_a_distillation_pulls_only_points_of_datasets_that_lack_classes() -> None:
    logits, labels = example(points=40)
    scan = torch.zeros(40, dtype=torch.long)
    rivals = torch.tensor([[True] * K, [True] * (K - 1) + [False]])
    gradients = []
    for source, teacher in ((0, torch.zeros(40, K)), (1, torch.zeros(40, K)), (1, logits)):
        student = logits.clone().requires_grad_()
        scored = Scored(student, labels, scan, scans=1, source=torch.full_like(scan, source))
        (gradient,) = torch.autograd.grad(distillation_loss(scored, teacher, rivals), student)
        gradients.append(gradient)
    assert (gradients[0] == 0).all()
    assert (gradients[1][labels > 0].abs().sum(dim=1) > 0).all()
    assert (gradients[1][labels == 0] == 0).all()
    # A network that gives the teacher's probabilities stays as it is.
    torch.testing.assert_close(gradients[2], torch.zeros(40, K))


@pytest.mark.parametrize("seed", range(4))
def test_a_voxel_has_the_label_of_most_of_its_labelled_points(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    cells = torch.randint(0, 40, (150,), generator=generator)
    labels = torch.randint(0, K + 1, (150,), generator=generator)
    labels[torch.rand(150, generator=generator) < 0.5] = 0

    expected = []
    for cell in range(40):
        inside = labels[cells == cell].tolist()
        counts = [inside.count(train_id) for train_id in range(1, K + 1)]
        expected.append(counts.index(max(counts)) + 1 if max(counts) else 0)
    assert 0 in expected
    assert majority_labels(cells, labels, 40, K).tolist() == expected


@pytest.mark.parametrize("seed", range(4))
def test_dice_equals_a_loop(seed: int) -> None:
    logits, target = example(seed=seed)
    probabilities = logits.softmax(dim=1)
    expected = dice_by_loop(probabilities.tolist(), target.tolist())
    assert region_of(dice, probabilities, target).item() == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("sharpness", [0.5, 2.0, 8.0])
@pytest.mark.parametrize("seed", range(4))
def test_lovasz_softmax_equals_its_definition_by_sets(seed: int, sharpness: float) -> None:
    logits, target = example(seed=seed)
    probabilities = (logits * sharpness).softmax(dim=1)
    assert region_of(lovasz_softmax, probabilities, target).item() == pytest.approx(
        lovasz_by_sets(probabilities.tolist(), target.tolist()), abs=2e-3
    )


def test_lovasz_softmax_sees_errors_of_a_few_percent() -> None:
    logits, target = example()
    probabilities = (logits / 4 + 5 * torch.nn.functional.one_hot(target, K)).softmax(dim=1)
    expected = lovasz_by_sets(probabilities.tolist(), target.tolist())
    assert expected < 0.05
    assert region_of(lovasz_softmax, probabilities, target).item() == pytest.approx(
        expected, abs=2e-3
    )


@LOSSES
def test_ignored_points_carry_no_gradient_and_the_others_do(region_loss: RegionLoss) -> None:
    logits, labels = example()
    logits.requires_grad_()
    loss_of(region_loss, logits, labels, torch.rand(K), 1.0).backward()
    assert (labels == 0).any()
    assert logits.grad is not None
    assert (logits.grad[labels == 0] == 0).all()
    assert logits.grad[labels > 0].any(dim=1).all()


@LOSSES
@pytest.mark.parametrize("points", [0, 7])
def test_if_all_is_ignored_loss_and_gradient_are_zero(region_loss: RegionLoss, points: int) -> None:
    logits = torch.randn(points, K, requires_grad=True)
    value = loss_of(region_loss, logits, torch.zeros(points, dtype=torch.uint8), torch.ones(K), 1.0)
    value.backward()
    assert value.item() == 0
    assert torch.equal(not_none(logits.grad), torch.zeros(points, K))


@LOSSES
def test_for_extreme_logits_the_gradient_of_the_loss_is_finite(region_loss: RegionLoss) -> None:
    logits, labels = example()
    logits = (logits * 1000).requires_grad_()
    loss_of(region_loss, logits, labels.to(torch.uint8), None, 1.0).backward()
    assert not_none(logits.grad).isfinite().all()


@pytest.mark.parametrize("power", [0.5, 0.4])
def test_class_weights_are_powers_of_the_inverse_frequency(power: float) -> None:
    weights = class_weights(np.array([100, 400, 2500]), power)
    assert weights.dtype == np.float32
    assert weights[0] / weights[1] == pytest.approx((400 / 100) ** power)
    assert weights[1] / weights[2] == pytest.approx((2500 / 400) ** power)
    assert weights.mean() == pytest.approx(1)
    np.testing.assert_allclose(class_weights(np.zeros(4, np.int64), power), 1, rtol=1e-6)


def test_absent_and_very_rare_classes_weigh_as_much_as_one_at_the_floor() -> None:
    weights = class_weights(np.array([10**9, 0, 3, round(FREQUENCY_FLOOR * 10**9)]))
    assert np.isfinite(weights).all()
    np.testing.assert_allclose(weights[1:], weights[1], rtol=1e-3)
    assert weights[1] / weights[0] == pytest.approx(math.sqrt(1 / FREQUENCY_FLOOR), rel=1e-3)
