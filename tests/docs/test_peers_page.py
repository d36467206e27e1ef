"""The page docs/peers.md: the programs with other tools give the IoU of `evaluate`."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amvnet.data.taxonomy import SEMANTICKITTI
from amvnet.weights.file import save

from fixtures.commands import commands_of, succeed
from fixtures.tiny import fresh_weights, make_streets

PAGE = "docs/peers.md"
WEIGHTS = "w.safetensors"


@pytest.fixture
def world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with a dataset and weights."""
    monkeypatch.chdir(tmp_path)
    make_streets(tmp_path / "dataset")
    save(fresh_weights(), WEIGHTS)
    return tmp_path


def adapt(text: str, world: Path) -> str:
    """Return a command or a program of the page, on the data and the weights of the test."""
    return text.replace("/data/kitti", str(world)).replace("sim-hdl64e", WEIGHTS)


def program(package: str, world: Path) -> dict[str, Any]:
    """Run the program of the page that uses a package; return its variables."""
    page = (Path(__file__).parents[2] / PAGE).read_text(encoding="utf-8")
    (text,) = [b for b in re.findall(r"(?s)```python\n(.*?)```", page) if package in b]
    variables: dict[str, Any] = {}
    exec(adapt(text, world), variables)
    return variables


def iou_of(options: str, world: Path, method: str = "amvnet") -> np.ndarray:
    """Return the IoU of each class that `evaluate` writes, NaN if there is nothing to count."""
    succeed(f"evaluate {world}/dataset --sequences 08 {options} --json iou.json --overwrite")
    iou = json.loads(Path("iou.json").read_text())["methods"][method]["iou"]
    return np.array([iou[name] for name in SEMANTICKITTI.classes], float)


def test_predictions_are_scored_like_the_weights(world: Path) -> None:
    predict, evaluate, of_others = [adapt(" ".join(w[1:]), world) for w in commands_of(PAGE)]
    succeed(predict)
    succeed(evaluate)
    Path("predictions").rename("test")
    succeed(of_others)
    of_weights = iou_of(f"--weights {WEIGHTS}", world)
    np.testing.assert_array_equal(iou_of("--predictions test", world, "predictions"), of_weights)


def test_open3d_gives_the_same_iou_and_writes_predictions_that_are_scored(world: Path) -> None:
    pytest.importorskip("open3d", reason="Open3D is not installed")
    variables = program("open3d", world)
    expected = iou_of(f"--weights {WEIGHTS}", world)
    np.testing.assert_allclose(variables["metric"].iou()[:-1], expected, atol=1e-9)

    split = variables["split"]
    for index in range(len(split)):
        scan = split.get_data(index)
        labels = variables["segmenter"](np.hstack([scan["point"], scan["feat"]])).labels
        results = {"predict_labels": labels.astype(np.int32) - 1}
        variables["kitti"].save_test_result(results, split.get_attr(index))
    np.testing.assert_array_equal(iou_of("--predictions test", world, "predictions"), expected)


def test_perceptionmetrics_gives_the_same_iou(world: Path) -> None:
    pytest.importorskip("perceptionmetrics", reason="PerceptionMetrics is not installed")
    table = program("perceptionmetrics", world)["table"]
    of_classes = table.loc["iou"][list(SEMANTICKITTI.classes)].to_numpy(float)
    expected = iou_of(f"--weights {WEIGHTS}", world)
    np.testing.assert_allclose(of_classes, expected, atol=1e-9)
