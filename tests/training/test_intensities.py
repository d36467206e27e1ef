"""A training sees the intensities that `predict` gives the finished weights, on any way there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amvnet.config.recipes import load_recipe
from amvnet.config.schema import PARTS, Recipe, StageName
from amvnet.data.datasets import simulated
from amvnet.data.datasets.open import open_dataset
from amvnet.data.datasets.training_data import to_train
from amvnet.sensors.expectation import Expectation
from amvnet.sensors.intensity import SIMULATED_QUANTILES
from amvnet.sensors.normalise import Normaliser, normalised
from amvnet.training.checking import first_weights
from amvnet.training.expectation import expectation_of, with_options
from amvnet.training.networks import make_loaders
from amvnet.training.plan import Plan
from amvnet.weights.file import Weights

from fixtures.tiny import fake_drive, fresh_weights, street, with_intensities, write_recipe

BOTH: tuple[StageName, ...] = ("rv", "bev")


@pytest.fixture(scope="module", params=["with intensity", "without intensity"])
def own(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scans of two classes; their intensities, if any, are darker than the simulated ones."""
    root = tmp_path_factory.mktemp("own")
    columns = 4 if request.param == "with intensity" else 3
    for seed, site in enumerate("ab"):
        for name in ("clouds", "truth"):
            (root / site / name).mkdir(parents=True)
        points, _ = street(seed)
        np.save(root / site / "clouds/0.npy", (points * [1, 1, 1, 0.1])[:, :columns])
        np.save(root / site / "truth/0.npy", np.where(points[:, 2] < -1, 3, 7))
    (root / "robot.yaml").write_text(
        "{classes: {ground: 3, plant: 7}, scans: '*/clouds/*.npy', labels: '../truth/{name}.npy'}"
    )
    write_recipe(root / "recipe.yaml")
    return root


def trained_before(weights: Weights, **how: bool) -> Weights:
    return with_intensities(weights, SIMULATED_QUANTILES["hdl64e"], **how)


@pytest.mark.parametrize("hides", [pytest.param(0.0, marks=pytest.mark.full), 0.3])
@pytest.mark.parametrize(
    ("begin", "stage"),
    [
        ("none", "all"),
        ("same classes", "all"),
        ("same classes", "rv"),
        ("same classes", "head"),
        ("other classes", "all"),
        ("unmatched", "all"),
        ("unmatched", "rv"),
        ("unmatched", "head"),
    ],
)
def test_predict_gives_finished_weights_the_intensities_of_their_training(
    own: Path, tmp_path: Path, begin: str, stage: Any, hides: float
) -> None:
    recipe = load_recipe(str(own / "recipe.yaml"))
    augment = replace(recipe.training.augment, no_intensity=hides)
    recipe = replace(recipe, training=replace(recipe.training, augment=augment))
    classes = open_dataset(str(own / "robot.yaml")).taxonomy
    inits: dict[str, Weights | None] = {
        "none": None,
        "same classes": trained_before(fresh_weights(classes), is_optional=True, is_matched=True),
        "other classes": trained_before(fresh_weights(), is_optional=True, is_matched=True),
        "unmatched": trained_before(fresh_weights(classes)),
    }

    data = str(own / "robot.yaml")
    plan = Plan.open(recipe, [data], tmp_path / "run", to_train, inits[begin], stage=stage)
    expects = expectation_of(plan.data, first_weights(plan), plan.recipe, plan.stages)
    _, val = make_loaders(plan, recipe.training.rv, expects)
    assert val is not None
    in_training = val.dataset[(0, 0)]

    dataset = normalised(open_dataset(data), Normaliser(expects))
    scan = expects.prepare(dataset.read(plan.data.val[0]))
    np.testing.assert_allclose(scan.points, in_training.points, atol=1e-6)


def test_networks_learn_to_do_without_intensities_unless_one_of_them_stays() -> None:
    recipe = Recipe()
    augment = replace(recipe.training.augment, no_intensity=0.25)
    hiding = replace(recipe, training=replace(recipe.training, augment=augment))
    known = Expectation.of_sensor("hdl64e")
    for parts, stages, expected in (
        ((), BOTH, True),
        (PARTS, BOTH, True),
        ((), ("rv",), True),
        (("range_net",), ("rv",), True),
        (PARTS, ("rv",), False),
        (("range_net",), ("bev",), False),
        (PARTS, ("head",), False),
    ):
        before = with_options(known, parts, hiding, stages)
        assert before.intensity is not None
        assert before.intensity.is_optional == expected
        assert with_options(before, parts, recipe, stages) == before  # they forget nothing


def test_streets_that_are_joined_with_others_are_matched_as_streets_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(simulated, "drive_street", fake_drive)
    monkeypatch.setattr(simulated, "SCANS", 2)
    write_recipe(tmp_path / "recipe.yaml", training={"augment": {"no_intensity": 0.25}})
    specs = [f"simulated-hdl64e:{tmp_path / name}" for name in "ab"]
    found: list[Any] = []
    for data in (specs[:1], specs):
        recipe = load_recipe(str(tmp_path / "recipe.yaml"))
        plan = Plan.open(
            recipe, data, tmp_path / "run", lambda each: to_train(each, ["0"], ["900000"])
        )
        weights = Weights(recipe.model, plan.data.taxonomy)
        found.append(expectation_of(plan.data, weights, plan.recipe, plan.stages).intensity)
    assert found[0].is_matched
    assert found[0].is_optional  # a quarter of the streets hide their intensities
    assert found[0] == found[1]
