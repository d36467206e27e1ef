"""The tools of the page, in a browser: box, corrections, tape, picture and table."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from amvnet.data.labels.readers import read_raw_labels
from amvnet.data.taxonomy import SEMANTICKITTI
from amvnet.viewing.page import write_page
from amvnet.viewing.shown_scans import ShownScan

from fixtures.browser_pages import Browser, browser, read_page, with_script

__all__ = ["browser"]

pytestmark = pytest.mark.full  # each starts a browser

PERSON = SEMANTICKITTI.classes.index("person") + 1
BOX = (-5.0, 0.0, -9.0, 5.0, 8.0, 1.5)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the page of two scans with ground truth and labels."""
    rng = np.random.default_rng(3)
    scans = []
    for name in ("a/000", "a/001"):
        points = rng.uniform((-15, -15, -2, 0), (15, 15, 2, 1), (2000, 4)).astype(np.float32)
        truth = rng.integers(1, 20, 2000)
        labels = np.where(rng.random(2000) < 0.3, 1, truth)
        shown = ShownScan(name, points, np.ones(2000, bool), truth, {"labels": labels})
        scans.append(replace(shown, corrected=f"site/truth/{name[2:]}.npy"))
    path = tmp_path_factory.mktemp("page") / "p.html"
    write_page(path, scans, SEMANTICKITTI, "tools")
    return path


def in_box(page: Path) -> np.ndarray:
    xyz, _ = read_page(page).scan(0)
    return np.asarray(((xyz >= BOX[:3]) & (xyz <= BOX[3:])).all(axis=1))


def test_only_points_in_the_box_are_drawn(page: Path, browser: Browser) -> None:
    _, planes = read_page(page).scan(0)
    state = browser.state(page, f"box={','.join(map(str, BOX))}")

    inside = in_box(page)
    assert 0 < inside.sum() < len(inside)
    assert state["drawn"] == np.bincount(planes["labels"][inside], minlength=20).tolist()
    assert state["console"] == []


@pytest.mark.parametrize("box", ["1,2,3", "a,b,c,d,e,f", "", "1,,,,,nan"])
def test_a_box_that_is_none_hides_nothing(page: Path, browser: Browser, box: str) -> None:
    assert sum(browser.state(page, f"box={box}")["drawn"]) == 2000


@pytest.mark.parametrize("ending", ["label", "npy", "txt", "bin"])
def test_corrected_labels_are_saved_in_the_form_of_their_place(
    ending: str, page: Path, tmp_path: Path, browser: Browser
) -> None:
    script = f"""
        editor.apply({PERSON});
        editor.apply(1);
        editor.undo();
        const saved = labelFile("a/b.{ending}", scan.planes.corrected, about.raw);
        document.title = [...saved].map((byte) => byte.toString(16).padStart(2, "0")).join("");
    """
    opened = with_script(page, tmp_path / "p.html", script)
    state = browser.state(opened, f"box={','.join(map(str, BOX))}")

    _, planes = read_page(page).scan(0)
    expected = np.where(in_box(page), PERSON, planes["labels"])
    raw = np.array(SEMANTICKITTI.train_to_raw, "<u4")[expected]
    path = tmp_path / f"b.{ending}"
    path.write_bytes(bytes.fromhex(state["title"]))
    np.testing.assert_array_equal(read_raw_labels(path, 2000, missing=0), raw)
    assert (state["console"], state["drawn"][PERSON]) == ([], in_box(page).sum())


def test_a_download_is_named_as_in_its_data(page: Path, tmp_path: Path, browser: Browser) -> None:
    script = f"editor.apply({PERSON}); saveFile = (blob, name) => {{ document.title = name; }};"
    script += "editor.save(); document.title += byId('edited').textContent"
    state = browser.state(with_script(page, tmp_path / "p.html", script))
    name = "site-truth-000.npy"
    assert state["title"] == f"{name}Saved as {name}; its place is site/truth/000.npy."


def test_a_scan_that_is_not_whole_cannot_be_corrected(tmp_path: Path, browser: Browser) -> None:
    points = np.array([[1, 2, 0, 0], [np.nan, 0, 0, 0], [3, 4, 0, 0]], np.float32)
    valid = np.array([True, False, True])
    shown = ShownScan("s", points, valid, None, {"labels": np.array([1, 0, 2])})
    write_page(tmp_path / "p.html", [shown], SEMANTICKITTI, "")
    state = browser.state(tmp_path / "p.html")
    (edit,) = [
        attributes for _, attributes in state["dom"].elements if attributes.get("id") == "edit"
    ]

    assert "hidden" in edit


@pytest.mark.parametrize("labelled", [True, False])
def test_only_labels_can_be_corrected(labelled: bool, tmp_path: Path, browser: Browser) -> None:
    points = np.array([[1, 2, 0, 0], [3, 4, 0, 0]], np.float32)
    labels = {"labels": np.array([1, 2])} if labelled else {}
    shown = ShownScan("s", points, np.ones(2, bool), None, labels)
    write_page(tmp_path / "p.html", [shown], SEMANTICKITTI, "")
    dom = browser.state(tmp_path / "p.html")["dom"]
    assert dom.texts["box-title"] == ("Box, correct labels" if labelled else "Box")


@pytest.mark.parametrize(("is_open", "least"), [(False, 0.8), (True, 0.45)])
def test_a_phone_shows_the_scan_above_the_panel(
    is_open: bool, least: float, page: Path, tmp_path: Path, browser: Browser
) -> None:
    """Windows of Chromium are wider than phones, frames are not."""
    script = "if (OPEN) panel.fold(); const { top } = byId('timeline').getBoundingClientRect();"
    script += "parent.postMessage(top / innerHeight, '*')"
    with_script(page, tmp_path / "inner.html", script.replace("OPEN", str(is_open).lower()))
    frame = '<iframe src="inner.html" style="width: 390px; height: 844px"></iframe>'
    listener = "<script>onmessage = ({ data }) => { document.title = data; }</script>"
    outer = tmp_path / "outer.html"
    outer.write_text(f"<!doctype html><html><title>-</title>{listener}{frame}</html>")
    assert least < float(browser.state(outer)["title"]) < 0.95


def test_the_tape_measures_metres(page: Path, tmp_path: Path, browser: Browser) -> None:
    script = "tape.toggle(); tape.add(7); tape.add(1234); draw()"
    state = browser.state(with_script(page, tmp_path / "p.html", script))

    xyz, _ = read_page(page).scan(0)
    expected = np.linalg.norm(xyz[7] - xyz[1234])
    assert float(state["data-length"]) == pytest.approx(expected, abs=0.006)
    assert f"{expected:.2f} m" in state["dom"].texts["length"]


def test_pictures_and_tables_cause_no_error(page: Path, tmp_path: Path, browser: Browser) -> None:
    script = "savePicture(); byId('show-table').click()"
    state = browser.state(with_script(page, tmp_path / "p.html", script))

    assert state["console"] == []
    (table,) = [
        attributes for _, attributes in state["dom"].elements if attributes.get("id") == "table"
    ]
    assert "open" in table


def test_an_error_of_the_page_is_noticed(page: Path, tmp_path: Path, browser: Browser) -> None:
    assert len(browser.state(with_script(page, tmp_path / "p.html", "nothing()"))["console"]) == 1
