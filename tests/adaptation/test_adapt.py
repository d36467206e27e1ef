"""Adaptation by the command line, with tiny networks on simulated scans."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from amvnet.adaptation import adapt as adapt_module
from amvnet.adaptation import targets
from amvnet.adaptation.adapt import Adaptation
from amvnet.adaptation.agreement import Trust
from amvnet.adaptation.sensor import hidden_directions, sensor_to_simulate
from amvnet.data.datasets.simulated import SCANS
from amvnet.scan import Scan
from amvnet.sensors.intensity import KEY as INTENSITY
from amvnet.sensors.measure import SensorGeometry
from amvnet.sensors.record import KEY as SENSOR
from amvnet.simulation import SENSORS
from amvnet.training.losses import class_weights
from amvnet.training.run import Run
from amvnet.weights.file import load, save

from fixtures.worlds import NO_PICTURES, TRAINING, fake_drive, fresh_weights, make_streets, run_cli


@pytest.fixture(autouse=True)
def quick_streets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(targets, "drive_street", fake_drive)


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make scans, a recipe of tiny rounds, and weights that have learnt such streets a little."""
    root = tmp_path_factory.mktemp("world")
    make_streets(root / "data", ("00", "01", "08"))
    tree: dict[str, Any] = {"base": "adapt", "training": {**TRAINING}}
    for name in ("rv", "bev"):
        tree["training"][name] = {"epochs": 2, "batch": 2, "lr": 0.002, "ema": 0.5}
    tree["training"]["adapt"] = {
        **{"points": 5, "lowest_confidence": 0.1, "quantile": 0.2, "agreement": 0.05},
        **{"rounds": 2, "streets": 2},
    }
    (root / "adapt.yaml").write_text(yaml.safe_dump(tree))

    tree["base"] = "finetune"
    for name in ("rv", "bev"):
        tree["training"][name] |= {"epochs": 12, "lr": 0.03, "ema": 0.0}
    (root / "train.yaml").write_text(yaml.safe_dump(tree))
    fresh = fresh_weights()
    # Networks this small are unsure and agree little.
    assertion = replace(fresh.model.assertion, threshold=0.5)
    save(
        replace(fresh, model=replace(fresh.model, assertion=assertion)), root / "fresh.safetensors"
    )
    code, error = run_cli(
        *("train", root / "train.yaml", "--data", root / "data", "--out", root / "start"),
        *("--init", root / "fresh.safetensors"),
        *NO_PICTURES,
    )
    assert code == 0, error
    return root


def call(world: Path, out: Path, *options: object, scans: str = "data") -> tuple[int, str]:
    return run_cli(
        *("adapt", world / scans, "--weights", world / "start", "--out", out),
        *("--recipe", world / "adapt.yaml", *options),
    )


@pytest.fixture(scope="module")
def run(world: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Adapt without interruption."""
    out = tmp_path_factory.mktemp("runs") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(targets, "drive_street", fake_drive)
        code, error = call(world, out)
    assert code == 0, error
    return out


def test_an_adaptation_ends_in_whole_weights_of_the_same_model(world: Path, run: Path) -> None:
    start = load(world / "start")
    adapted = load(run)
    assert adapted.model == start.model
    assert adapted.parts == start.parts
    for part in ("range_net", "polar_net"):
        assert adapted.digest(part) != start.digest(part)
    assert adapted.digest("point_head") == start.digest("point_head")
    assert adapted.training["range_net"]["adapted"]["scans"] == 6


def test_an_adaptation_says_how_sure_it_is_and_draws_before_and_after(run: Path) -> None:
    report = json.loads((run / "adaptation.json").read_text())
    assert 0 < len(report["rounds"]) <= 2
    assert set(report["uncertain"]) == {"before", "after"}
    assert len(report["told"]) == 19
    assert len(list((run / "pictures").glob("*.png"))) == 3


def test_labels_are_never_read(
    world: Path, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Scans whose label files are broken are adapted to as those with good ones."""
    make_streets(world / "unlabelled", ("00", "01", "08"))
    for path in (world / "unlabelled").rglob("*.label"):
        path.write_bytes(b"no labels")
    code, error = call(world, tmp_path / "run", scans="unlabelled")
    assert code == 0, error
    same_parts(tmp_path / "run", run)


@pytest.mark.parametrize("stages", [0, 1])
def test_an_interrupted_run_leaves_no_weights_and_resumes_to_the_same(
    world: Path, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stages: int
) -> None:
    with monkeypatch.context() as patch:
        kill_after(stages, patch)
        assert call(world, tmp_path / "run")[0] == 1
    assert not (tmp_path / "run/weights.safetensors").exists()

    code, error = call(world, tmp_path / "run")
    assert code == 2
    assert "--resume" in error
    code, error = call(world, tmp_path / "run", "--resume")
    assert code == 0, error
    same_parts(tmp_path / "run", run)


def kill_after(stages: int, patch: pytest.MonkeyPatch) -> None:
    """Let every training after the first ones be interrupted."""
    done: list[Run] = []
    train = Run.stages

    def killed(self: Run, *arguments: Any) -> Path:
        if len(done) == stages:
            raise KeyboardInterrupt
        done.append(self)
        return train(self, *arguments)

    patch.setattr(Run, "stages", killed)


def test_weights_without_a_head_get_one(
    world: Path, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = load(world / "start")
    tensors = {
        name: tensor for name, tensor in start.tensors.items() if not name.startswith("point_head.")
    }
    save(replace(start, tensors=tensors), tmp_path / "networks.safetensors")
    options = ("--weights", tmp_path / "networks.safetensors")
    with monkeypatch.context() as patch:
        kill_after(2, patch)
        assert call(world, tmp_path / "run", *options)[0] == 1

    code, error = call(world, tmp_path / "run", *options, "--resume")
    assert code == 0, error
    adapted = load(tmp_path / "run")
    assert "point_head" in adapted.parts
    for part in ("range_net", "polar_net"):
        assert adapted.digest(part) == load(run).digest(part)


def same_parts(a: Path, b: Path) -> None:
    first = load(a)
    second = load(b)
    for part in first.parts:
        assert first.digest(part) == second.digest(part)


def test_another_run_is_not_resumed(world: Path, run: Path) -> None:
    code, error = call(world, run, "--resume", "--sequences", "00")
    assert code == 2
    assert "other scans" in error


def test_scan_files_are_adapted_to_and_their_rows_kept(world: Path, tmp_path: Path) -> None:
    code, error = call(world, tmp_path / "run", scans="data/sequences/00/velodyne")
    assert code == 0, error
    with np.load(tmp_path / "run/scans/000000.npz") as file:
        assert set(file.files) == {"points", "ring"}
    adapted = load(tmp_path / "run")
    start = load(world / "start")
    assert adapted.model == start.model

    # Later scans must be brought to the frame that these were brought to.
    for part in ("range_net", "polar_net"):
        for key in (INTENSITY, SENSOR):
            assert adapted.training[part].get(key) == start.training.get(part, {}).get(key)


def test_the_rounds_end_when_too_little_of_the_start_still_stands(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The weights are those of the last good round; if there is none, there are no weights."""
    shares = iter([0.9, 0.0])
    monkeypatch.setattr(adapt_module, "agreement", lambda *_: next(shares))
    assert call(world, tmp_path / "run")[0] == 0
    first = load(tmp_path / "run/round-1")
    adapted = load(tmp_path / "run")
    assert adapted.digest("range_net") == first.digest("range_net")
    assert adapted.digest("polar_net") == first.digest("polar_net")

    monkeypatch.setattr(adapt_module, "agreement", lambda *_: 0.0)
    code, error = call(world, tmp_path / "other")
    assert code == 2
    assert error.count("\n") == 1
    assert not (tmp_path / "other/weights.safetensors").exists()


def test_a_class_that_cannot_be_told_is_not_weighted_up() -> None:
    class Parts:
        weights = fresh_weights()
        streets = type("Streets", (), {"records": lambda self: [], "read": None})()

    ids = np.repeat(np.arange(1, 20), np.arange(1, 20) ** 3).astype(np.uint8)
    told = np.arange(19) % 2 == 0
    trusted = Trust(np.ones(19), np.ones(19), told)
    look = type("Look", (), {"pseudo_labels": [ids], "trusted": trusted})()
    found = Adaptation._class_weights(Parts(), look)  # type: ignore[arg-type]

    expected = class_weights(np.bincount(ids)[1:] / len(ids))
    np.testing.assert_allclose(found[told], expected[told], rtol=1e-6)
    assert (found[~told] <= 1).all()
    assert (expected[~told] > 1).any()


def test_the_known_sensor_is_simulated_with_its_own_lasers() -> None:
    scans = [Scan(np.ones((1000, 4), np.float32))]
    known = SensorGeometry(64, 2.0, -24.5, 1.5)
    assert sensor_to_simulate(known, scans, "hdl64e").elevations == SENSORS["hdl64e"].elevations
    assert sensor_to_simulate(known, scans, "hdl64e").height == 1.5


def test_another_sensor_is_simulated_as_measured() -> None:
    azimuth = np.radians(np.linspace(0, 180, 16_000, endpoint=False))
    points = np.column_stack([10 * np.cos(azimuth), 10 * np.sin(azimuth), 0 * azimuth, azimuth])
    scans = [Scan(points.astype(np.float32))]
    sensor = sensor_to_simulate(SensorGeometry(16, 15.0, -15.0, 0.6), scans, "hdl64e")
    assert sensor.elevations == pytest.approx(np.linspace(15, -15, 16))
    assert sensor.height == 0.6
    assert sensor.azimuth_steps == 16_000 / 16 * 2 / 0.8

    hidden = hidden_directions(scans)
    assert sum(end - start for start, end, _, _ in hidden) == 180
    assert min(start for start, _, _, _ in hidden) == 180
    assert SCANS * 2 == 12
