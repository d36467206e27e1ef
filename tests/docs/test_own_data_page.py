"""The page docs/own_data.md, on a dataset of five classes in a layout of no benchmark."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from amvnet.weights.file import load, save
from lidarstreets import LIDAR_MODELS

from fixtures.commands import succeed
from fixtures.own_scans import CLASSES, make_own_scans, make_robot_quick
from fixtures.pages import Changes, DocsPage, run
from fixtures.tiny import fresh_weights, simulate_in_this_process, write_recipe

PAGE = DocsPage("docs/own_data.md")
ONE_EPOCH = {"rv": {"epochs": 1}, "bev": {"epochs": 1}, "head": {"epochs": 1}}


@pytest.mark.full
def test_every_command_of_the_page_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("embreex")
    simulate_in_this_process(monkeypatch)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("AMVNET_CACHE", str(tmp_path / "cache"))
    recipe = write_recipe(tmp_path / "tiny.yaml", training=ONE_EPOCH)
    save(fresh_weights(), tmp_path / "init.safetensors")
    (few,) = [block for block in PAGE.blocks("yaml") if "structure: {from" in block]
    (tmp_path / "few.yaml").write_text(few)
    changes = Changes(
        words={"semantickitti-compact": str(recipe), "sim-any": "init.safetensors"},
        values={
            "simulate": {"--scans": 1},
            "train": {"--training.rv.epochs": 1, "--training.bev.epochs": 1},
        },
    )
    run(PAGE.commands, changes)

    (block,) = [block for block in PAGE.blocks("yaml") if "ignored: [-1]" in block]
    assert re.sub(r"\s*#.*", "", block) == Path("robot/robot.yaml").read_text()
    for name in ("robot", "new"):
        weights = load(f"runs/{name}")
        assert weights.taxonomy.classes == tuple(CLASSES)
        assert weights.parts == ("range_net", "polar_net", "point_head")
    assert "the same command with --stage head" in capsys.readouterr().out

    # The files, their folder and the dataset get the same labels, in the user's own ids.
    for path in sorted(Path("robot/site_d/clouds").glob("*.pcd")):
        of_dataset = np.fromfile(f"labels_of_val/site_d/clouds/{path.stem}.label", np.uint32)
        of_folder = np.fromfile(f"labels_of_files/{path.stem}.label", np.uint32)
        assert set(of_dataset.tolist()) <= {raw for raw, _ in CLASSES.values()} | {65535}
        np.testing.assert_array_equal(of_dataset, of_folder)

    # The sensor of the training scans is kept: +-15 degrees, brought to the height of the recipe.
    sensor = load("runs/new").expects.sensor
    assert (sensor.fov_up, sensor.fov_down) == pytest.approx((15, -15), abs=2)
    assert sensor.height == 1.73 != LIDAR_MODELS["vlp16"].height
    assert "site_d" in Path("next.csv").read_text()
    assert Path("runs/new/curves.png").read_bytes().startswith(b"\x89PNG")


def test_scores_are_of_the_users_classes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_robot_quick(monkeypatch)
    data = make_own_scans(tmp_path)
    truth = np.load(tmp_path / "site_c/truth/0000.npy")
    for path in sorted((tmp_path / "site_c/truth").glob("*.npy")):
        target = tmp_path / "perfect/site_c/clouds" / f"{path.stem}.label"
        target.parent.mkdir(parents=True, exist_ok=True)
        (np.load(path).astype(np.int64) & 0xFFFF).astype(np.uint32).tofile(target)
    assert (truth == -1).any()

    figures = tmp_path / "figures.json"
    succeed("evaluate", data, "--predictions", tmp_path / "perfect", "--json", figures)
    report = json.loads(figures.read_text())["methods"]["predictions"]
    assert (list(report["iou"]), report["accuracy"]) == (list(CLASSES), 1)
