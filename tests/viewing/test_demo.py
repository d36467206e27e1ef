"""`amvnet demo` leaves a page that a browser opens without an error."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from amvnet.cli.commands import demo
from amvnet.data.taxonomy import NUSCENES
from amvnet.weights.file import Weights, save

from fixtures.browser_pages import Browser, browser, read_page
from fixtures.commands import run_cli
from fixtures.tiny import fresh_weights, make_simulation_quick

__all__ = ["browser"]


def run_demo(root: Path, weights: Weights, *options: object) -> tuple[int, str]:
    save(weights, root / "w.safetensors")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demo, "SEQUENCES", 1)
        patch.setattr(demo, "SCANS", 1)
        options = ("--weights", root / "w.safetensors", "--out", root / "demo", *options)
        return run_cli("demo", *options)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("demo")
    with pytest.MonkeyPatch.context() as patch:
        make_simulation_quick(patch)
        assert run_demo(root, fresh_weights()) == (0, "")
    return root / "demo"


def test_the_table_of_the_page_has_the_figures_that_are_written(folder: Path) -> None:
    report = json.loads((folder / "metrics.json").read_text())
    table = read_page(folder / "index.html").about["table"]
    expected = [round(100 * method["miou"], 1) for method in report["methods"].values()]
    assert table["totals"][0]["values"] == expected


@pytest.mark.full
def test_the_browser_opens_the_page_without_an_error(folder: Path, browser: Browser) -> None:
    state = browser.state(folder / "index.html", "color=uncertainty")
    assert state["console"] == []
    assert sum(state["drawn"]) > 100


@pytest.mark.full
def test_weights_of_the_other_sensor_get_its_streets_and_each_seed_its_own(tmp_path: Path) -> None:
    pytest.importorskip("embreex")
    pages = []
    for seed in (1, 2):
        assert run_demo(tmp_path, fresh_weights(NUSCENES), "--seed", seed, "--overwrite") == (0, "")
        pages.append(read_page(tmp_path / "demo/index.html"))

    for page in pages:
        assert page.about["classes"][1:] == list(NUSCENES.classes)
        assert len(page.about["scans"]) == 1
    assert pages[0].texts["scan-0"] != pages[1].texts["scan-0"]


def test_weights_with_classes_that_no_street_has_are_refused(tmp_path: Path) -> None:
    weights = fresh_weights()
    names = ("floor", *weights.taxonomy.classes[1:])
    weights = replace(weights, taxonomy=replace(weights.taxonomy, classes=names))
    code, error = run_demo(tmp_path, weights)
    assert code == 2
    assert "floor" in error
    assert error.count("\n") == 1
