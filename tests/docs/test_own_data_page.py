"""The page docs/own_data.md, on a dataset of five classes in a layout of no benchmark."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from amvnet.weights.file import load, save

from fixtures.own_scans import CLASSES, DESCRIPTION, HEIGHT, SITES, make_own_scans
from fixtures.worlds import commands_of, fresh_weights, run_cli, write_recipe

PAGE = "docs/own_data.md"
ONE_EPOCH = {"rv": {"epochs": 1}, "bev": {"epochs": 1}, "head": {"epochs": 1}}


def without_comments(text: str) -> str:
    return re.sub(r"\s*#.*", "", text)


def test_every_command_of_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    make_own_scans(tmp_path)
    recipe = write_recipe(tmp_path / "tiny.yaml", training=ONE_EPOCH)
    save(fresh_weights(), tmp_path / "init.safetensors")
    blocks = re.findall(r"```yaml\n(.*?)```", (Path(__file__).parents[2] / PAGE).read_text(), re.S)
    (few,) = [block for block in blocks if "structure: {from" in block]
    (tmp_path / "few.yaml").write_text(few)
    changes = {
        "semantickitti-compact": str(recipe),
        "simulated-compact": str(recipe),
        "sim-hdl64e": "init.safetensors",
    }

    for _, *words in commands_of(PAGE):
        code, error = run_cli(*[changes.get(word, word) for word in words])
        assert code == 0, error

    for run in ("robot", "robot64"):
        weights = load(f"runs/{run}")
        assert weights.taxonomy.classes == tuple(CLASSES)
        assert weights.parts == ("range_net", "polar_net", "point_head")

    # The files, their folder and the dataset get the same labels, in the user's own ids.
    for path in sorted(Path("site_c/clouds").glob("*.pcd")):
        of_dataset = np.fromfile(f"labels/site_c/clouds/{path.stem}.label", np.uint32)
        of_folder = np.fromfile(f"labels_of_files/{path.stem}.label", np.uint32)
        assert set(of_dataset.tolist()) <= {raw for raw, _ in CLASSES.values()} | {65535}
        np.testing.assert_array_equal(of_dataset, of_folder)

    # The sensor of the training scans is kept: +-15 degrees, brought to the height of the recipe.
    sensor = load("runs/robot").training["range_net"]["sensor"]
    assert (sensor["fov_up"], sensor["fov_down"]) == pytest.approx((15, -15), abs=2)
    assert sensor["height"] == 1.73 != HEIGHT
    assert "site_c" in Path("next.csv").read_text()


def test_the_file_of_the_page_is_the_one_that_is_tested() -> None:
    page = (Path(__file__).parents[2] / PAGE).read_text()
    block = re.search(r"`robot.yaml`:\n\n```yaml\n(.*?)```", page, re.S)
    assert block is not None
    assert without_comments(block[1]) == DESCRIPTION
    assert all(site in page for site in SITES)


def test_scores_are_of_the_users_classes(tmp_path: Path) -> None:
    data = make_own_scans(tmp_path)
    truth = np.load(tmp_path / "site_c/truth/0000.npy")
    for path in sorted((tmp_path / "site_c/truth").glob("*.npy")):
        target = tmp_path / "perfect/site_c/clouds" / f"{path.stem}.label"
        target.parent.mkdir(parents=True, exist_ok=True)
        (np.load(path).astype(np.int64) & 0xFFFF).astype(np.uint32).tofile(target)
    assert (truth == -1).any()

    figures = tmp_path / "figures.json"
    code, error = run_cli(
        "evaluate", data, "--predictions", tmp_path / "perfect", "--json", figures
    )
    assert code == 0, error
    report = json.loads(figures.read_text())["methods"]["predictions"]
    assert list(report["iou"]) == list(CLASSES)
    assert report["accuracy"] == 1
