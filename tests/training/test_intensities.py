"""A training sees the intensities that `predict` gives the finished weights, on any way there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amvnet.config.recipes import load_recipe
from amvnet.data.datasets import simulated
from amvnet.data.datasets.open import open_dataset
from amvnet.data.datasets.select import split_records
from amvnet.inference.reading import normalised, normaliser_for
from amvnet.sensors.intensity import (
    MATCHED_KEY,
    QUANTILES_KEY,
    SIMULATED_QUANTILES,
    adapt_intensity,
    trained_intensity,
)
from amvnet.training.networks import intensity_of, make_loaders
from amvnet.training.plan import Plan
from amvnet.training.run import first_weights
from amvnet.training.run_folder import PART_OF
from amvnet.training.sensor_record import sensor_record
from amvnet.weights.file import Weights

from fixtures.tiny import fake_drive, fresh_weights, street, write_recipe

BOTH = ("rv", "bev")


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


def trained_before(weights: Weights, no_intensity: float, is_matched: bool) -> Weights:
    record = {
        "augment": {"no_intensity": no_intensity},
        QUANTILES_KEY: list(SIMULATED_QUANTILES["hdl64e"]),
        MATCHED_KEY: is_matched,
    }
    return replace(weights, training={"range_net": record, "polar_net": record})


@pytest.mark.parametrize("hides", [pytest.param(0.0, marks=pytest.mark.full), 0.3])
@pytest.mark.parametrize(
    ("begin", "stages"),
    [
        ("none", BOTH),
        ("same classes", BOTH),
        ("same classes", ("rv",)),
        ("same classes", ("head",)),
        ("other classes", BOTH),
        ("unmatched", BOTH),
        ("unmatched", ("rv",)),
        ("unmatched", ("head",)),
    ],
)
def test_predict_gives_finished_weights_the_intensities_of_their_training(
    own: Path, tmp_path: Path, begin: str, stages: tuple[str, ...], hides: float
) -> None:
    recipe = load_recipe(str(own / "recipe.yaml"))
    augment = replace(recipe.training.augment, no_intensity=hides)
    recipe = replace(recipe, training=replace(recipe.training, augment=augment))
    classes = open_dataset(str(own / "robot.yaml")).taxonomy
    inits: dict[str, Weights | None] = {
        "none": None,
        "same classes": trained_before(fresh_weights(classes), 0.25, is_matched=True),
        "other classes": trained_before(fresh_weights(), 0.25, is_matched=True),
        "unmatched": trained_before(fresh_weights(classes), 0.0, is_matched=False),
    }
    init = inits[begin]

    data = str(own / "robot.yaml")
    plan = Plan.open(
        recipe,
        [data],
        tmp_path / "run",
        lambda dataset: split_records(dataset, None, None),
        init,
        stage="all" if stages == BOTH else stages[0],
    )
    weights = first_weights(plan, init, stages)
    intensity = intensity_of(plan, weights)
    if stages == ("head",):
        intensity = trained_intensity(weights.training, weights.sensor)
    _, val = make_loaders(plan, recipe.training.rv, intensity)
    assert val is not None
    in_training = val.dataset[(0, 0)]

    augments = {"augment": {"no_intensity": hides}}
    record = augments | sensor_record(plan.scans.dataset, plan.scans.train, intensity)
    learnt = {PART_OF[name]: record for name in stages if name != "head"}
    finished = replace(weights, training={**weights.training, **learnt})
    dataset = normalised(open_dataset(data), normaliser_for(finished))
    scan = dataset.read(plan.scans.val[0])
    scan = adapt_intensity(scan, trained_intensity(finished.training, finished.sensor))
    np.testing.assert_allclose(scan.points, in_training.points, atol=1e-6)


def test_streets_that_are_joined_with_others_are_matched_as_streets_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(simulated, "drive_street", fake_drive)
    monkeypatch.setattr(simulated, "SCANS", 2)
    augment = {"no_intensity": 0.25}
    write_recipe(tmp_path / "recipe.yaml", training={"augment": augment})
    specs = [f"simulated-hdl64e:{tmp_path / name}" for name in "ab"]
    found: list[Any] = []
    for data in (specs[:1], specs):
        recipe = load_recipe(str(tmp_path / "recipe.yaml"))
        plan = Plan.open(
            recipe, data, tmp_path / "run", lambda each: split_records(each, ["0"], ["900000"])
        )
        found.append(intensity_of(plan, Weights(recipe.model, plan.scans.dataset.taxonomy, "x")))
    assert found[0].is_matched
    assert found[0].is_optional  # a quarter of the streets hide their intensities
    assert found[0] == found[1]
