"""A page or a recording holds what the scans, the labels and the networks say, and a browser draws that."""

from __future__ import annotations

import base64
import hashlib
import os
import re
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from amvnet.data.datasets.nuscenes import NuScenes
from amvnet.data.datasets.open import open_dataset
from amvnet.data.datasets.semantickitti import SemanticKitti
from amvnet.data.taxonomy import NUSCENES, SEMANTICKITTI
from amvnet.inference.segmenter import Segmenter
from amvnet.viewing import page as pages
from amvnet.viewing import rerun_log as view
from amvnet.viewing.frames import RIGHT, WRONG, Frame
from amvnet.weights.file import save

from fixtures.browser_pages import Browser, Page, browser, places, read_page
from fixtures.worlds import (
    GOLDEN,
    commands_of,
    files,
    fresh_weights,
    make_streets,
    run_cli,
    street,
    without,
)

__all__ = ["browser"]

REAL = os.environ.get("AMVNET_REAL_DATA", "")
HOSTILE = "</script><img src=x onerror=\"document.title='owned'\">&amp;'\"@@ABOUT@@"


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of six scans, weights, a lone scan, and the page of all six by the weights."""
    root = tmp_path_factory.mktemp("world")
    make_streets(root / "data")
    save(fresh_weights(), root / "w.safetensors")
    street(7, 300)[0].tofile(root / "lone.bin")
    made = run_cli(
        "view",
        root / "data",
        "--weights",
        root / "w.safetensors",
        "--scans",
        9,
        "--html",
        root / "p.html",
    )
    assert made == (0, "")
    return root


@pytest.fixture(scope="module")
def dataset(world: Path) -> SemanticKitti:
    return SemanticKitti(world / "data")


def frame(points: np.ndarray, **known: np.ndarray) -> Frame:
    points = points.astype(np.float32)
    return Frame("scan", points, np.isfinite(points).all(axis=1), known.pop("truth", None), known)


def written(path: Path, *frames: Frame, title: str = "title") -> Page:
    return read_page(pages.write_page(path, frames, SEMANTICKITTI, title))


# ---- what the page holds


def test_every_scan_is_in_the_page_as_it_is(world: Path, dataset: SemanticKitti) -> None:
    page, segmenter = read_page(world / "p.html"), Segmenter(world / "w.safetensors")
    records = dataset.records(dataset.sequences("all"))
    assert [scan["name"] for scan in page.about["scans"]] == [record.name for record in records]
    for place, record in enumerate(records):
        scan = dataset.read(record)
        xyz, planes = page.scan(place)
        step = np.asarray(page.about["scans"][place]["step"])
        assert (step < 0.001).all()
        assert (np.abs(xyz - scan.points[:, :3]) <= 0.51 * step + 1e-5).all()
        assert (
            np.abs(planes["intensity"] / 255 - np.clip(scan.points[:, 3], 0, 1)).max()
            <= 0.5 / 255 + 1e-6
        )
        assert scan.labels is not None
        np.testing.assert_array_equal(planes["truth"], scan.labels)
        labels, uncertain = segmenter.by_method(scan)
        assert list(labels) == ["rv", "bev", "ensemble", "amvnet"]
        for method, ids in labels.items():
            np.testing.assert_array_equal(planes[method], ids)
        np.testing.assert_array_equal(planes["uncertain"], uncertain)


def test_disagreement_is_one_less_the_cosine(world: Path, dataset: SemanticKitti) -> None:
    segmenter = Segmenter(world / "w.safetensors")
    found = segmenter(dataset.read(dataset.records(["00"])[0]))
    assert found.rv is not None
    assert found.bev is not None
    lengths = np.linalg.norm(found.rv, axis=1) * np.linalg.norm(found.bev, axis=1)
    expected = 1 - (found.rv * found.bev).sum(axis=1) / lengths
    _, planes = read_page(world / "p.html").scan(0)
    np.testing.assert_allclose(planes["disagreement"] / 255, expected, atol=0.6 / 255)


def test_the_page_names_classes_and_colours_officially(world: Path) -> None:
    about = read_page(world / "p.html").about
    assert about["classes"][1:] == list(SEMANTICKITTI.classes)
    assert [tuple(color) for color in about["colors"][1:]] == list(SEMANTICKITTI.colors[1:])
    assert [source["key"] for source in about["sources"]] == [
        "truth",
        "rv",
        "bev",
        "ensemble",
        "amvnet",
    ]


def test_points_without_a_place_are_left_out_and_counted(tmp_path: Path) -> None:
    points = np.array([[1, 2, 3, 0.5], [np.nan, 0, 0, 0], [4, 5, 6, 2.0], [0, 0, 501, 0]])
    page = written(tmp_path / "p.html", frame(points, labels=np.array([1, 2, 3, 4])))
    xyz, planes = page.scan(0)
    np.testing.assert_allclose(xyz, points[[0, 2], :3], atol=1e-4)
    assert planes["labels"].tolist() == [1, 3]
    assert planes["intensity"].tolist() == [128, 255]
    assert page.about["scans"][0]["note"].startswith("2 ")


@pytest.mark.parametrize("extent", [0.0, 0.01, 100.0, 499.0])
def test_positions_are_within_half_a_step(tmp_path: Path, extent: float) -> None:
    points = np.random.default_rng(0).uniform(-extent, extent, (1000, 4))
    page = written(tmp_path / "p.html", frame(points))
    assert (
        np.abs(page.scan(0)[0] - points[:, :3].astype(np.float32)).max()
        <= max(extent, 1e-3) / 65_534 * 1.01
    )


def test_a_huge_scan_is_thinned_evenly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pages, "MOST_POINTS", 100)
    points, ids = np.random.default_rng(0).normal(size=(250, 4)), np.arange(250) % 20
    page = written(tmp_path / "p.html", frame(points, labels=ids))
    assert page.scan(0)[1]["labels"].tolist() == ids[::3].tolist()
    assert "one in 3" in page.about["scans"][0]["note"]


def test_a_scan_of_120_thousand_points_takes_under_two_megabytes(tmp_path: Path) -> None:
    points, raw = street(0, 120_000)  # in no order, so that they deflate worse than a sensor's do
    ids, rng = SEMANTICKITTI.to_train(raw), np.random.default_rng(0)
    doubt = rng.random(len(points)) ** 8
    some = {
        name: np.where(rng.random(len(points)) < 0.1, 13, ids)
        for name in ("rv", "bev", "ensemble", "amvnet")
    }
    whole = replace(frame(points, truth=ids, **some), uncertain=doubt > 0.1, disagreement=doubt)
    path = pages.write_page(tmp_path / "p.html", [whole], SEMANTICKITTI, "")
    assert path.stat().st_size < 2e6


def test_the_same_frames_give_the_same_bytes(tmp_path: Path) -> None:
    points, raw = street(3)
    texts = [
        pages.write_page(
            tmp_path / name, [frame(points, labels=SEMANTICKITTI.to_train(raw))], SEMANTICKITTI, "t"
        )
        for name in ("a.html", "b.html")
    ]
    assert texts[0].read_bytes() == texts[1].read_bytes()


# ---- what the page must not do


def test_nothing_is_fetched(world: Path) -> None:
    page = read_page(world / "p.html")
    text = (world / "p.html").read_text()
    assert not re.search(
        r"https?:|\bimport\b\s*[({'\"]|@import|url\(|fetch\(|XMLHttpRequest|WebSocket", text
    )
    for _, attributes in page.elements:
        assert not {"src", "srcset", "action", "ping"} & set(attributes)
        assert attributes.get("href") in (None, "data:,")


def test_no_script_runs_but_the_package_s_own(world: Path) -> None:
    page = read_page(world / "p.html")
    policy = (
        next(a["content"] for tag, a in page.elements if tag == "meta" and a.get("http-equiv"))
        or ""
    )
    said = dict(part.strip().split(" ", 1) for part in policy.split(";"))
    assert said["default-src"] == "'none'"
    for tag in ("script", "style"):
        digest = base64.b64encode(hashlib.sha256(page.texts[f"<{tag}>"].encode()).digest()).decode()
        assert said[f"{tag}-src"] == f"'sha256-{digest}'"
    assert not any(name.startswith("on") for _, attributes in page.elements for name in attributes)


def hostile_page(path: Path) -> Page:
    points, raw = street(5)
    classes = (HOSTILE, *SEMANTICKITTI.classes[1:])
    some = replace(frame(points, labels=SEMANTICKITTI.to_train(raw)), name=HOSTILE)
    return read_page(
        pages.write_page(path, [some], replace(SEMANTICKITTI, classes=classes), HOSTILE)
    )


def test_names_stay_names(tmp_path: Path) -> None:
    page = hostile_page(tmp_path / "p.html")
    harmless = written(tmp_path / "q.html", frame(street(5)[0]))
    assert [tag for tag, _ in page.elements] == [tag for tag, _ in harmless.elements]
    assert page.texts["<title>"] == HOSTILE
    assert (
        page.about["title"] == page.about["classes"][1] == page.about["scans"][0]["name"] == HOSTILE
    )


def test_a_name_that_is_no_unicode_is_written(tmp_path: Path) -> None:
    assert (
        written(tmp_path / "p.html", frame(street(5)[0]), title=os.fsdecode(b"caf\xe9")).texts[
            "<title>"
        ]
        == "caf?"
    )


# ---- what is shown of which input


def view_page(tmp_path: Path, *arguments: object) -> Page:
    assert run_cli("view", *arguments, "--html", tmp_path / "out.html") == (0, "")
    return read_page(tmp_path / "out.html")


def test_a_lone_scan_needs_nothing_else(world: Path, tmp_path: Path) -> None:
    page = view_page(tmp_path, world / "lone.bin")
    assert page.about["scans"][0]["planes"] == ["intensity"]
    assert page.about["sources"] == []
    assert page.texts["<title>"] == "lone.bin"


def test_labels_that_predict_wrote_are_shown(world: Path, tmp_path: Path) -> None:
    weights = ("--weights", world / "w.safetensors", "--out", tmp_path / "labels")
    assert run_cli("predict", world / "data", world / "lone.bin", *weights)[0] == 0
    expected = read_page(world / "p.html")
    page = view_page(tmp_path, world / "data", "--labels", tmp_path / "labels", "--scans", 6)
    for place in range(6):
        found = page.scan(place)[1]
        assert list(found) == ["intensity", "truth", "labels"]
        np.testing.assert_array_equal(found["labels"], expected.scan(place)[1]["amvnet"])
    by_folder = view_page(tmp_path, world / "lone.bin", "--labels", tmp_path / "labels").scan(0)[1]
    by_file = view_page(
        tmp_path, world / "lone.bin", "--labels", tmp_path / "labels/lone.label"
    ).scan(0)[1]
    by_weights = view_page(tmp_path, world / "lone.bin", "--weights", world / "w.safetensors").scan(
        0
    )[1]
    np.testing.assert_array_equal(by_folder["labels"], by_weights["amvnet"])
    np.testing.assert_array_equal(by_file["labels"], by_weights["amvnet"])


def test_labels_are_read_with_the_classes_that_are_named(world: Path, tmp_path: Path) -> None:
    np.arange(300, dtype=np.uint32).__mod__(17).tofile(tmp_path / "lone.label")
    options = (world / "lone.bin", "--labels", tmp_path / "lone.label", "--taxonomy", "nuscenes")
    page = view_page(tmp_path, *options)
    assert page.about["classes"][1:] == list(NUSCENES.classes)
    assert page.scan(0)[1]["labels"].tolist() == [i % 17 for i in range(300)]


def test_one_network_alone_has_no_doubts(world: Path, tmp_path: Path) -> None:
    save(without(fresh_weights(), "polar_net", "point_head"), tmp_path / "rv.safetensors")
    page = view_page(tmp_path, world / "lone.bin", "--weights", tmp_path / "rv.safetensors")
    assert page.about["scans"][0]["planes"] == ["intensity", "rv"]


def test_nuscenes_is_shown_with_its_truth(tmp_path: Path) -> None:
    page = view_page(tmp_path, f"nuscenes:{GOLDEN / 'nuscenes'}")
    golden = open_dataset(f"nuscenes:{GOLDEN / 'nuscenes'}")
    assert isinstance(golden, NuScenes)
    first = golden.records(golden.sequences("all"))[0]
    truth = golden.read(first).labels
    np.testing.assert_array_equal(page.scan(0)[1]["truth"], truth)
    assert page.about["scans"][0]["name"].startswith(first.sequence)


@pytest.mark.parametrize(("count", "chosen"), [(1, ["00/000000"]), (2, ["00/000000", "08/000001"])])
def test_scans_are_chosen_evenly(
    world: Path, tmp_path: Path, count: int, chosen: list[str]
) -> None:
    page = view_page(tmp_path, world / "data", "--scans", count)
    assert [scan["name"] for scan in page.about["scans"]] == chosen


MISTAKES = {
    "labels and weights": "{w}/data --labels {w}/data --weights {w}/w.safetensors --html {out}/p.html",
    "no input": "{w}/none.bin --html {out}/p.html",
    "no labels": "{w}/data --labels {w}/none --html {out}/p.html",
    "labels of another scan": "{w}/lone.bin --labels {w}/data/sequences/00/labels/000000.label --html {out}/p.html",
    "one file for many scans": "{w}/data --labels {w}/data/sequences/00/labels/000000.label --html {out}/p.html",
    "no scans": "{w}/data --scans 0 --html {out}/p.html",
    "unknown taxonomy": "{w}/lone.bin --taxonomy cities --html {out}/p.html",
    "taxonomy beside weights": "{w}/lone.bin --taxonomy nuscenes --weights {w}/w.safetensors --html {out}/p.html",
    "different classes": "{w}/data {golden}/nuscenes --html {out}/p.html",
    "page below a file": "{w}/data --html {w}/lone.bin/p.html",
    "sequence not there": "{w}/data --sequences 05 --html {out}/p.html",
}


@pytest.mark.parametrize("line", MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_gets_one_line(line: str, world: Path, tmp_path: Path) -> None:
    before = files(world)
    code, said = run_cli("view", *line.format(w=world, out=tmp_path, golden=GOLDEN).split())
    assert code == 2
    assert said.startswith("amvnet: ")
    assert said.count("\n") == 1
    assert files(world) == before
    assert not files(tmp_path)


def test_without_rerun_the_line_says_what_to_install(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    for options in ((), ("--save", tmp_path / "r.rrd")):
        code, said = run_cli("view", world / "data", *options)
        assert (code, said.count("\n")) == (2, 1)
        assert 'pip install "amvnet[view]"' in said
    assert run_cli("view", world / "data", "--html", tmp_path / "p.html")[0] == 0
    assert files(tmp_path) == {"p.html"}


# ---- what a browser draws


def drawn(
    planes: dict[str, np.ndarray],
    labels: str,
    keep: np.ndarray | None = None,
    hide: tuple[int, ...] = (),
) -> list[int]:
    """The points that are to be drawn, by class."""
    ids = planes[labels] if keep is None else planes[labels][keep]
    counts = np.bincount(ids, minlength=20)
    counts[list(hide)] = 0
    return list(counts.tolist())


def test_the_browser_draws_the_points_that_are_asked_for(world: Path, browser: Browser) -> None:
    page = world / "p.html"
    planes = read_page(page).scan(0)[1]
    ids = np.unique(planes["rv"])[:2]
    hidden = ",".join(map(str, ids))
    state = browser.state(page, f"color=error&labels=rv&hide={hidden}")
    assert (state["data-color"], state["drawn"]) == ("error", drawn(planes, "rv", hide=tuple(ids)))
    wrong = (planes["truth"] > 0) & (planes["bev"] != planes["truth"])
    assert browser.state(page, "only=wrong&labels=bev&hide=99&size=nan&color=none")[
        "drawn"
    ] == drawn(planes, "bev", wrong)
    other = read_page(page).scan(3)[1]
    state = browser.state(page, "scan=4&labels=truth&only=uncertain&color=height")
    assert (state["data-scan"], state["drawn"]) == (
        "3",
        drawn(other, "truth", other["uncertain"] > 0),
    )


def test_a_click_on_a_class_hides_it(world: Path, tmp_path: Path, browser: Browser) -> None:
    """The page without its policy and with a hand that clicks."""
    planes = read_page(world / "p.html").scan(0)[1]
    road = SEMANTICKITTI.classes.index("road") + 1
    click = f"<script>setTimeout(() => document.querySelector('#classes [data-id=\"{road}\"]').click(), 500)</script>"
    text = re.sub(r"<meta http-equiv[^>]*>", "", (world / "p.html").read_text())
    (tmp_path / "p.html").write_text(text.replace("</body>", click + "</body>"))
    assert browser.state(tmp_path / "p.html", "labels=truth")["drawn"] == drawn(
        planes, "truth", hide=(road,)
    )


def test_the_picture_shows_what_is_asked_for_where_it_is(tmp_path: Path, browser: Browser) -> None:
    """From above, x up and y to the left: cars left, green right, and wrong labels at the bottom."""
    rng = np.random.default_rng(0)
    points = rng.uniform((-15, -15, -0.1, 0), (15, 15, 0.1, 1), (20_000, 4))
    truth = np.where(points[:, 1] > 0, 1, 15)
    labels = np.where(points[:, 0] > 0, truth, 13)
    path, look = tmp_path / "p.html", "size=2&camera=3.1416,1.5708,40,0,0,0"
    pages.write_page(path, [frame(points, truth=truth, labels=labels)], SEMANTICKITTI, "")
    car, building, green = (SEMANTICKITTI.colors[c] for c in (1, 13, 15))
    shown = browser.picture(path, look)
    assert places(shown, car)[1].max() < places(shown, green)[1].min() + 3
    assert places(shown, car)[0].max() < places(shown, building)[0].min() + 3
    errors = browser.picture(path, f"{look}&color=error&hide=15")
    assert places(errors, RIGHT)[1].max() < places(shown, green)[1].min() + 3
    assert places(errors, RIGHT)[0].max() < places(errors, WRONG)[0].min() + 3
    assert len(places(errors, car)[0]) == len(places(errors, building)[0]) == 0


def test_a_hostile_name_is_shown_and_not_run(tmp_path: Path, browser: Browser) -> None:
    hostile_page(tmp_path / "p.html")
    state = browser.state(tmp_path / "p.html")
    assert state["title"] == HOSTILE
    assert state["drawn"] is not None
    assert not [tag for tag, _ in state["dom"].elements if tag == "img"]


# ---- Rerun


def test_a_recording_reads_back(world: Path, tmp_path: Path, dataset: SemanticKitti) -> None:
    reader = pytest.importorskip("rerun.chunk").RrdReader
    options = (
        "--weights",
        world / "w.safetensors",
        "--sequences",
        "08",
        "--save",
        tmp_path / "r.rrd",
    )
    assert run_cli("view", world / "data", *options)[0] == 0
    found: dict[str, list[dict[str, list[object]]]] = {}
    for chunk in reader(tmp_path / "r.rrd").stream():
        batch = chunk.to_record_batch()
        columns = [name for name in batch.schema.names if name == "scan" or ":" in name]
        found.setdefault(chunk.entity_path, []).append(
            {name: batch.column(name).to_pylist() for name in columns}
        )
    segmenter = Segmenter(world / "w.safetensors")
    for step, record in enumerate(dataset.records(["08"])):
        scan = dataset.read(record)
        labels, uncertain = segmenter.by_method(scan)
        assert uncertain is not None
        assert scan.labels is not None
        wrong = (scan.labels > 0) & (labels["rv"] != scan.labels)
        assert column(found["/truth"], step, "class_ids") == scan.labels.tolist()
        for method, ids in labels.items():
            assert column(found[f"/labels/{method}"], step, "class_ids") == ids.tolist()
        places = np.asarray(column(found["/errors/rv"], step, "positions"))
        np.testing.assert_array_equal(places, scan.points[wrong, :3])
        np.testing.assert_array_equal(
            column(found["/uncertain"], step, "positions"), scan.points[uncertain, :3]
        )
        share = 100 * wrong.sum() / (scan.labels > 0).sum()
        assert column(found["/percent/wrong/rv"], step, "scalars") == pytest.approx([share])


def column(chunks: list[dict[str, list[object]]], step: int, name: str) -> list[object]:
    """The values of one component at one step of the time line."""
    for chunk in chunks:
        for row, place in enumerate(chunk["scan"]):
            if place == step:
                values = next(values for key, values in chunk.items() if key.endswith(name))[row]
                assert isinstance(values, list)
                return values
    raise AssertionError(f"nothing at step {step}")


# ---- real scans, and the page of the documentation


@pytest.mark.skipif(not REAL, reason="AMVNET_REAL_DATA names no folder")
def test_five_real_scans_take_a_few_megabytes(tmp_path: Path) -> None:
    page = view_page(tmp_path, f"{REAL}/semantickitti", "--weights", "sim-hdl64e")
    assert len(page.about["scans"]) == 5
    assert all(scan["count"] > 100_000 for scan in page.about["scans"])
    assert (tmp_path / "out.html").stat().st_size < 5e6


def test_the_commands_of_the_documentation_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("embreex")
    opened: list[int] = []
    monkeypatch.setattr(view, "check_window", lambda: None)
    monkeypatch.setattr(view, "open_window", lambda frames, taxonomy: opened.append(1))
    monkeypatch.chdir(tmp_path)
    commands = [words[1:] for words in commands_of("docs/viewing.md") if words[0] == "amvnet"]
    assert commands
    for command in commands:
        if "--save" in command and find_spec("rerun") is None:
            continue
        assert run_cli(*command) == (0, ""), command
        made = [
            command[command.index(option) + 1]
            for option in ("--html", "--save")
            if option in command
        ]
        assert all((tmp_path / name).stat().st_size for name in made)
    assert opened
