"""The page docs/peers.md: the programs with other tools give the IoU of `evaluate`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amvnet.data.taxonomy import SEMANTICKITTI
from amvnet.weights.file import save

from fixtures.commands import succeed
from fixtures.pages import Changes, DocsPage, execute, run
from fixtures.tiny import fresh_weights, make_streets

PAGE = DocsPage("docs/peers.md")
WEIGHTS = "w.safetensors"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    make_streets(tmp_path / "dataset")
    save(fresh_weights(), WEIGHTS)
    return tmp_path


def changes(folder: Path) -> Changes:
    return Changes(texts={"/data/kitti": str(folder), "sim-hdl64e": WEIGHTS})


def program(package: str, folder: Path) -> dict[str, Any]:
    """Run the program of the page that uses a package; return its variables."""
    (text,) = [block for block in PAGE.blocks("python") if package in block]
    return execute([changes(folder).of_text(text)])


def iou_of(options: str, folder: Path, method: str = "amvnet") -> np.ndarray:
    """Return the IoU of each class that `evaluate` writes, NaN if there is nothing to count."""
    succeed(f"evaluate {folder}/dataset --sequences 08 {options} --json iou.json --overwrite")
    iou = json.loads(Path("iou.json").read_text())["methods"][method]["iou"]
    return np.array([iou[name] for name in SEMANTICKITTI.classes], float)


def test_predictions_are_scored_like_the_weights(folder: Path) -> None:
    *own, of_others = PAGE.commands
    assert len(own) == 2
    run(own, changes(folder))
    Path("predictions").rename("test")
    run([of_others], changes(folder))
    of_weights = iou_of(f"--weights {WEIGHTS}", folder)
    np.testing.assert_array_equal(iou_of("--predictions test", folder, "predictions"), of_weights)


def test_open3d_gives_the_same_iou_and_writes_predictions_that_are_scored(folder: Path) -> None:
    pytest.importorskip("open3d", reason="Open3D is not installed")
    variables = program("open3d", folder)
    expected = iou_of(f"--weights {WEIGHTS}", folder)
    np.testing.assert_allclose(variables["metric"].iou()[:-1], expected, atol=1e-9)

    split = variables["split"]
    for index in range(len(split)):
        scan = split.get_data(index)
        labels = variables["segmenter"](np.hstack([scan["point"], scan["feat"]])).labels
        results = {"predict_labels": labels.astype(np.int32) - 1}
        variables["kitti"].save_test_result(results, split.get_attr(index))
    np.testing.assert_array_equal(iou_of("--predictions test", folder, "predictions"), expected)


def test_perceptionmetrics_gives_the_same_iou(folder: Path) -> None:
    pytest.importorskip("perceptionmetrics", reason="PerceptionMetrics is not installed")
    table = program("perceptionmetrics", folder)["table"]
    of_classes = table.loc["iou"][list(SEMANTICKITTI.classes)].to_numpy(float)
    expected = iou_of(f"--weights {WEIGHTS}", folder)
    np.testing.assert_allclose(of_classes, expected, atol=1e-9)
