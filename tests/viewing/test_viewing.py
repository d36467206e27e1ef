"""A page holds what the scans, labels and networks say, and a browser draws it."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import re
import tempfile
import webbrowser
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import amvnet
from amvnet.data.class_maps import class_map
from amvnet.data.datasets.nuscenes import NuScenes
from amvnet.data.datasets.open import open_dataset
from amvnet.data.datasets.semantickitti import SemanticKitti
from amvnet.data.labels.readers import read_raw_labels
from amvnet.data.labels.writers import write_scan_labels
from amvnet.data.taxonomy import NUSCENES, SEMANTICKITTI, WRONG_COLOR, class_colors
from amvnet.errors import InputError
from amvnet.evaluation.scoring import labels_by_method
from amvnet.files import unfinished
from amvnet.viewing import page as pages
from amvnet.viewing.shown_scans import CORRECT, ShownScan, shown_scan
from amvnet.weights.file import save

from fixtures.browser_pages import Browser, Page, browser, pixels_of, read_page, with_script
from fixtures.commands import files, not_none, refusal, refused, run_cli
from fixtures.marks import with_full
from fixtures.pages import Changes, DocsPage, run
from fixtures.scan_writers import write_bag1
from fixtures.tiny import GOLDEN, fresh_weights, make_simulation_quick, street, without

__all__ = ["browser"]

HOSTILE = "</script><img src=x onerror=\"document.title='owned'\">&amp;'\"@@ABOUT@@"


@pytest.fixture(scope="module")
def path(world: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    html = tmp_path_factory.mktemp("page") / "p.html"
    options = ("--weights", world / "w.safetensors", "--scans", 9, "--html", html)
    assert run_cli("view", world / "data", *options) == (0, "")
    return html


@pytest.fixture(scope="module")
def dataset(world: Path) -> SemanticKitti:
    return SemanticKitti(world / "data")


def make_scan(
    points: np.ndarray, truth: np.ndarray | None = None, **labels: np.ndarray
) -> ShownScan:
    points = points.astype(np.float32)
    return ShownScan("scan", points, np.isfinite(points).all(axis=1), truth, labels)


def write_and_read(path: Path, *scans: ShownScan, title: str = "title") -> Page:
    pages.write_page(path, scans, SEMANTICKITTI, title)
    return read_page(path)


def scan_names(page: Page) -> list[str]:
    return [scan["name"] for scan in page.about["scans"]]


def tags(page: Page) -> list[str]:
    return [tag for tag, _ in page.elements]


# ---- what the page holds


def test_every_scan_is_in_the_page_as_it_is(path: Path, dataset: SemanticKitti) -> None:
    page = read_page(path)
    records = dataset.records(dataset.sequences("all"))
    assert scan_names(page) == [record.name for record in records]

    for index, record in enumerate(records):
        scan = dataset.read(record)
        xyz, planes = page.scan(index)
        step = np.asarray(page.about["scans"][index]["step"])
        assert (step < 0.001).all()
        assert (np.abs(xyz - scan.points[:, :3]) <= 0.51 * step + 1e-5).all()
        intensity = np.clip(scan.points[:, 3], 0, 1)
        assert np.abs(planes["intensity"] / 255 - intensity).max() <= 0.5 / 255 + 1e-6
        np.testing.assert_array_equal(planes["truth"], not_none(scan.labels))


def test_the_page_has_all_methods_labels(world: Path, path: Path, dataset: SemanticKitti) -> None:
    page = read_page(path)
    segmenter = amvnet.load(world / "w.safetensors")
    for index, record in enumerate(dataset.records(dataset.sequences("all"))):
        _, planes = page.scan(index)
        labels, uncertain, _ = labels_by_method(segmenter, dataset.read(record))
        assert list(labels) == ["rv", "bev", "ensemble", "amvnet"]
        for method, ids in labels.items():
            np.testing.assert_array_equal(planes[method], ids)
        np.testing.assert_array_equal(planes["uncertain"], uncertain)


def test_the_page_has_all_probabilities_and_the_disagreement(
    world: Path, path: Path, dataset: SemanticKitti
) -> None:
    segmentation = amvnet.load(world / "w.safetensors")(dataset.read(dataset.records(["00"])[0]))
    rv = segmentation.rv
    bev = segmentation.bev
    assert rv is not None
    assert bev is not None
    scores = {"rv": rv, "bev": bev, "ensemble": np.sqrt(rv * bev), "amvnet": segmentation.scores}

    _, planes = read_page(path).scan(0)
    for method, values in scores.items():
        shares = values / values.sum(axis=1, keepdims=True)
        expected = shares[np.arange(len(shares)), planes[method] - 1]
        np.testing.assert_allclose(planes[f"{method}-probability"] / 100, expected, atol=0.006)

    shares = np.sort(shares, axis=1)
    np.testing.assert_allclose(planes["second-probability"] / 100, shares[:, -2], atol=0.006)
    assert (planes["second"] != planes["amvnet"]).mean() > 0.99  # unless two classes are equal

    lengths = np.linalg.norm(rv, axis=1) * np.linalg.norm(bev, axis=1)
    disagreement = 1 - (rv * bev).sum(axis=1) / lengths  # one minus the cosine
    np.testing.assert_allclose(planes["disagreement"] / 255, disagreement, atol=0.6 / 255)


def test_the_page_is_as_sure_as_the_result(dataset: SemanticKitti, world: Path) -> None:
    """Also of points to which both networks together give no score."""
    result = amvnet.load(world / "w.safetensors")(dataset.read(dataset.records(["00"])[0]))
    scores = result.scores.copy()
    scores[:5] = 0
    result = replace(result, scores=scores)

    shown = shown_scan(result, result.require_origin())
    sure = shown.probabilities[result.require_origin().method]
    np.testing.assert_allclose(sure, result.confidence, atol=1e-6)
    assert (sure[:5] > 0).all()


def test_the_table_of_the_page_is_that_of_evaluate(world: Path, path: Path, tmp_path: Path) -> None:
    figures = tmp_path / "figures.json"
    options = ("--weights", world / "w.safetensors", "--split", "all", "--json", figures)
    assert run_cli("evaluate", world / "data", *options)[0] == 0
    report = json.loads(figures.read_text())

    table = read_page(path).about["table"]
    assert table["methods"] == ["RV", "BEV", "ensemble", "AMVNet"]
    assert table["scans"] == report["scans"]
    for column, method in enumerate(report["methods"].values()):
        assert table["totals"][0]["values"][column] == pytest.approx(100 * method["miou"], abs=0.06)
        for row in table["rows"]:
            iou = method["iou"][SEMANTICKITTI.classes[row["class"] - 1]]
            value = row["values"][column]
            assert value == (None if iou is None else pytest.approx(100 * iou, abs=0.06))


def test_the_page_names_classes_and_colours_officially(path: Path) -> None:
    about = read_page(path).about
    assert about["classes"][1:] == list(SEMANTICKITTI.classes)
    np.testing.assert_array_equal(about["colors"][1:], class_colors(SEMANTICKITTI)[1:])

    keys = [source["key"] for source in about["sources"]]
    assert keys == ["truth", "rv", "bev", "ensemble", "amvnet"]


def test_points_without_a_place_are_left_out_and_counted(tmp_path: Path) -> None:
    points = np.array([[1, 2, 3, 0.5], [np.nan, 0, 0, 0], [4, 5, 6, 2.0], [0, 0, 501, 0]])
    page = write_and_read(tmp_path / "p.html", make_scan(points, labels=np.array([1, 2, 3, 4])))
    xyz, planes = page.scan(0)

    np.testing.assert_allclose(xyz, points[[0, 2], :3], atol=1e-4)
    assert (planes["labels"].tolist(), planes["intensity"].tolist()) == ([1, 3], [128, 255])
    assert page.about["scans"][0]["note"].startswith("2 ")


@pytest.mark.parametrize("extent", [0.0, 0.01, 100.0, 499.0])
def test_positions_are_within_half_a_step(tmp_path: Path, extent: float) -> None:
    points = np.random.default_rng(0).uniform(-extent, extent, (1000, 4))
    xyz, _ = write_and_read(tmp_path / "p.html", make_scan(points)).scan(0)
    error = np.abs(xyz - points[:, :3].astype(np.float32)).max()
    assert error <= max(extent, 1e-3) / 65_534 * 1.01


def test_a_huge_scan_is_thinned_evenly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pages, "MAX_POINTS", 100)
    points = np.random.default_rng(0).normal(size=(250, 4))
    ids = np.arange(250) % 20
    page = write_and_read(tmp_path / "p.html", make_scan(points, labels=ids))
    _, planes = page.scan(0)

    assert planes["labels"].tolist() == ids[::3].tolist()
    assert "one in 3" in page.about["scans"][0]["note"]


@pytest.mark.full
def test_a_scan_of_120_thousand_points_takes_under_two_megabytes(tmp_path: Path) -> None:
    points, raw = street(0, 120_000)  # in random order, so that they deflate worse than real scans
    truth = SEMANTICKITTI.to_train(raw)
    rng = np.random.default_rng(0)
    disagreement = rng.random(len(points)) ** 8
    labels = {}
    for method in ("rv", "bev", "ensemble", "amvnet"):
        labels[method] = np.where(rng.random(len(points)) < 0.1, 13, truth)

    shown = make_scan(points, truth, **labels)
    shown = replace(shown, uncertain=disagreement > 0.1, disagreement=disagreement)
    pages.write_page(tmp_path / "p.html", [shown], SEMANTICKITTI, "")

    assert (tmp_path / "p.html").stat().st_size < 2e6


def test_the_same_scans_give_the_same_bytes(tmp_path: Path) -> None:
    points, raw = street(3)
    shown = make_scan(points, labels=SEMANTICKITTI.to_train(raw))
    for name in ("a.html", "b.html"):
        pages.write_page(tmp_path / name, [shown], SEMANTICKITTI, "t")

    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()


# ---- what the page must not do


def test_nothing_is_fetched(path: Path) -> None:
    text = path.read_text()
    for pattern in ("https?:", r"\bimport\b\s*[({'\"]", "@import", r"(url|fetch)\("):
        assert not re.search(pattern, text), pattern
    assert not re.search("XMLHttpRequest|WebSocket", text)

    for _, attributes in read_page(path).elements:
        assert not {"src", "srcset", "action", "ping"} & set(attributes)
        assert attributes.get("href") in (None, "data:,")


def policy_of(page: Page) -> dict[str, str]:
    for tag, attributes in page.elements:
        if tag == "meta" and attributes.get("http-equiv"):
            return dict(re.findall(r"([a-z-]+) ([^;]+)", attributes["content"] or ""))
    raise AssertionError("expected a policy, found none")


def test_no_script_runs_but_the_package_s_own(path: Path) -> None:
    page = read_page(path)
    policy = policy_of(page)

    assert policy["default-src"] == "'none'"
    for tag in ("script", "style"):
        digest = hashlib.sha256(page.texts[f"<{tag}>"].encode()).digest()
        assert policy[f"{tag}-src"] == f"'sha256-{base64.b64encode(digest).decode()}'"

    for _, attributes in page.elements:
        for name in attributes:
            assert not name.startswith("on")


def hostile_page(path: Path) -> Page:
    points, raw = street(5)
    truth = SEMANTICKITTI.to_train(raw)  # with a table of scores
    shown = replace(make_scan(points, truth, labels=truth), name=HOSTILE)
    taxonomy = replace(SEMANTICKITTI, classes=(HOSTILE, *SEMANTICKITTI.classes[1:]))
    pages.write_page(path, [shown], taxonomy, HOSTILE)
    return read_page(path)


def test_names_stay_names(tmp_path: Path) -> None:
    page = hostile_page(tmp_path / "p.html")
    harmless = write_and_read(tmp_path / "q.html", make_scan(street(5)[0]))

    assert tags(page) == tags(harmless)
    assert (page.texts["<title>"], page.about["title"]) == (HOSTILE, HOSTILE)
    assert page.about["classes"][1] == HOSTILE
    assert page.about["table"] is not None
    assert page.about["scans"][0]["name"] == HOSTILE


def test_a_name_that_is_no_unicode_is_written(tmp_path: Path) -> None:
    name = os.fsdecode(b"caf\xe9")
    page = write_and_read(tmp_path / "p.html", make_scan(street(5)[0]), title=name)
    assert page.texts["<title>"] == "caf?"


# ---- what is shown of which input


def view_page(tmp_path: Path, *arguments: object) -> Page:
    assert run_cli("view", *arguments, "--html", tmp_path / "out.html", "--overwrite") == (0, "")
    return read_page(tmp_path / "out.html")


def test_a_lone_scan_needs_nothing_else(world: Path, tmp_path: Path) -> None:
    page = view_page(tmp_path, world / "lone.bin")
    assert (page.about["scans"][0]["planes"], page.about["sources"]) == (["intensity"], [])
    assert page.texts["<title>"] == "lone.bin"


def test_labels_that_predict_wrote_are_shown(world: Path, path: Path, tmp_path: Path) -> None:
    weights = ("--weights", world / "w.safetensors", "--out", tmp_path / "labels")
    assert run_cli("predict", world / "data", world / "lone.bin", *weights)[0] == 0

    expected = read_page(path)
    page = view_page(tmp_path, world / "data", "--labels", tmp_path / "labels", "--scans", 6)
    for index in range(6):
        _, planes = page.scan(index)
        _, expected_planes = expected.scan(index)
        assert list(planes) == ["intensity", "truth", "labels"]
        np.testing.assert_array_equal(planes["labels"], expected_planes["amvnet"])


def test_labels_are_read_with_the_classes_that_are_named(world: Path, tmp_path: Path) -> None:
    ids = np.arange(300, dtype=np.uint32) % 17
    ids.tofile(tmp_path / "lone.label")
    options = (world / "lone.bin", "--labels", tmp_path / "lone.label", "--taxonomy", "nuscenes")
    page = view_page(tmp_path, *options)

    assert page.about["classes"][1:] == list(NUSCENES.classes)
    _, planes = page.scan(0)
    assert planes["labels"].tolist() == ids.tolist()


@pytest.mark.parametrize("kind", with_full(["label", "npy", "csv", "ply"], ["label", "npy"]))
def test_labels_of_all_formats_of_predict_are_shown(world: Path, tmp_path: Path, kind: str) -> None:
    scan = world / "lone.bin"
    weights = ("--weights", world / "w.safetensors", "--out", tmp_path / "labels")
    assert run_cli("predict", scan, *weights, "--format", kind)[0] == 0

    _, expected = view_page(tmp_path, scan, *weights[:2]).scan(0)
    for labels in (tmp_path / "labels", tmp_path / f"labels/lone.{kind}"):
        _, planes = view_page(tmp_path, scan, "--labels", labels).scan(0)
        np.testing.assert_array_equal(planes["labels"], expected["amvnet"])


@pytest.mark.parametrize("kind", with_full(["ply", "pcd", "las", "laz"], ["ply", "pcd"]))
def test_a_file_of_predict_shows_its_labels_itself(world: Path, tmp_path: Path, kind: str) -> None:
    options = ("--weights", world / "w.safetensors", "--out", tmp_path, "--format", kind)
    assert run_cli("predict", world / "lone.bin", *options, "--classes", "coarse")[0] == 0
    ids = read_raw_labels(tmp_path / f"lone.{kind}", 300, missing=0)

    page = view_page(tmp_path, tmp_path / f"lone.{kind}")
    assert page.about["classes"][1:] == list(class_map("coarse").target.classes)
    assert [source["key"] for source in page.about["sources"]] == ["labels"]
    _, planes = page.scan(0)
    assert planes["labels"].tolist() == ids.tolist()


def test_a_file_shows_its_labels_only_in_its_own_classes(world: Path, tmp_path: Path) -> None:
    options = ("--weights", world / "w.safetensors", "--out", tmp_path, "--format", "ply")
    assert run_cli("predict", world / "lone.bin", *options)[0] == 0
    ply = tmp_path / "lone.ply"
    refused(("view", ply, "--taxonomy", "nuscenes"), ply, "classes of nuscenes", "semantickitti")

    ply.write_bytes(re.sub(rb"comment [^\n]*\n", b"", ply.read_bytes()))
    assert view_page(tmp_path, ply).about["sources"] == []


@pytest.mark.parametrize("legend", ["classes []", 'class {"id": []}', "class [", "classes " * 99])
def test_comments_of_a_stranger_are_no_classes(tmp_path: Path, legend: str) -> None:
    header = f"ply\nformat ascii 1.0\ncomment amvnet {legend}\nelement vertex 1\n"
    path = tmp_path / "a.ply"
    path.write_text(
        header + "".join(f"property float {x}\n" for x in "xyz") + "end_header\n1 2 3\n"
    )
    assert view_page(tmp_path, path).about["sources"] == []


def test_a_map_far_from_its_origin_is_shown(tmp_path: Path) -> None:
    place = np.array([600.4, 1600.3, -30.0])
    xyz = np.random.default_rng(0).uniform(-40, 40, (500, 3)) + place
    ids = np.arange(500) % 20
    path = write_scan_labels(tmp_path / "map", "ply", xyz, ids, SEMANTICKITTI)
    page = view_page(tmp_path, path)

    shown, planes = page.scan(0)
    origin = page.about["scans"][0]["origin"]
    assert np.abs(shown).max() < 60
    np.testing.assert_allclose(shown + origin, xyz, atol=0.01)
    assert planes["labels"].tolist() == ids.tolist()


def test_scans_are_read_as_predict_reads_them(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    points = np.fromfile(world / "lone.bin", np.float32).reshape(-1, 4)
    capsys.readouterr()
    expected, _ = view_page(tmp_path, world / "lone.bin").scan(0)
    assert "assumed intensity 0 to 1, axes x-forward" in capsys.readouterr().out
    camera = np.column_stack([-points[:, 1], -points[:, 2], points[:, 0], points[:, 3]])
    write_bag1(tmp_path / "a.bag", {"/camera": [camera], "/empty": [camera[:1]]})
    capsys.readouterr()

    options = ("--topic", "/camera", "--axes", "z-forward")
    positions, _ = view_page(tmp_path, tmp_path / "a.bag", *options).scan(0)
    np.testing.assert_allclose(positions, expected, atol=0.01)
    assert "assumed intensity 0 to 1, axes z-forward" in capsys.readouterr().out

    points[:, [2, 3, 0, 1]].astype(np.float64).tofile(tmp_path / "a.bin")
    options = ("--columns", "z,intensity,x,y", "--dtype", "float64")
    positions, _ = view_page(tmp_path, tmp_path / "a.bin", *options).scan(0)
    np.testing.assert_allclose(positions, expected, atol=0.01)

    options = ("--weights", str(world / "w.safetensors"), "--height", "1.5")
    capsys.readouterr()
    view_page(tmp_path, world / "lone.bin", *options)
    assert "sensor 1.50 m over the ground" in capsys.readouterr().out


def test_one_network_alone_has_no_doubts(world: Path, tmp_path: Path) -> None:
    save(without(fresh_weights(), "polar_net", "point_head"), tmp_path / "rv.safetensors")
    page = view_page(tmp_path, world / "lone.bin", "--weights", tmp_path / "rv.safetensors")
    planes = ["intensity", "rv", "rv-probability", "second", "second-probability"]
    assert page.about["scans"][0]["planes"] == planes


def test_nuscenes_is_shown_with_its_truth(tmp_path: Path) -> None:
    name = f"nuscenes:{GOLDEN / 'nuscenes'}"
    page = view_page(tmp_path, name)
    golden = open_dataset(name)
    assert isinstance(golden, NuScenes)

    first = golden.records(golden.sequences("all"))[0]
    _, planes = page.scan(0)
    np.testing.assert_array_equal(planes["truth"], golden.read(first).labels)
    assert page.about["scans"][0]["name"].startswith(first.sequence)


@pytest.mark.parametrize(("count", "chosen"), [(1, ["00/000000"]), (2, ["00/000000", "08/000001"])])
def test_scans_are_chosen_evenly(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], count: int, chosen: list[str]
) -> None:
    assert scan_names(view_page(tmp_path, world / "data", "--scans", count)) == chosen
    assert f"{count} of 6 scans in" in capsys.readouterr().out


MISTAKES = {
    "labels and weights": "{w}/data --labels {w}/data --weights {w}/w.safetensors",
    "no input": "{w}/none.bin",
    "no labels": "{w}/data --labels {w}/none",
    "labels of another scan": "{w}/lone.bin --labels {w}/data/sequences/00/labels/000000.label",
    "one file for many scans": "{w}/data --labels {w}/data/sequences/00/labels/000000.label",
    "no scans": "{w}/data --scans 0",
    "unknown taxonomy": "{w}/lone.bin --taxonomy cities",
    "taxonomy and weights": "{w}/lone.bin --taxonomy nuscenes --weights {w}/w.safetensors",
    "different classes": "{w}/data {golden}/nuscenes",
    "page below a file": "{w}/data --html {w}/lone.bin/p.html",
    "sequence not there": "{w}/data --sequences 05",
}


@pytest.mark.parametrize("line", MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_gets_one_line(line: str, world: Path, tmp_path: Path) -> None:
    before = files(world)
    arguments = line.format(w=world, golden=GOLDEN).split()
    if "--html" not in arguments:
        arguments += ["--html", str(tmp_path / "p.html")]
    assert refusal("view", *arguments).startswith("amvnet: ")
    assert files(world) == before
    assert not files(tmp_path)


def test_without_a_file_a_temporary_page_opens_in_the_browser(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    assert run_cli("view", world / "data") == (0, "")

    (page,) = tmp_path.glob("*/scan.html")
    assert opened == [page.as_uri()]
    assert len(scan_names(read_page(page))) == 5


def test_a_temporary_page_that_is_not_written_leaves_no_folder(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: object) -> None:
        assert set(tmp_path.iterdir()) <= unfinished  # a signal removes it
        raise InputError("expected a, found b; c")

    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(pages, "pack", fail)
    refused(("view", world / "data"))
    assert not list(tmp_path.iterdir())


# ---- what a browser draws


def count_by_class(ids: np.ndarray, hidden: Sequence[int] = ()) -> list[int]:
    """Count the points of each class that are to be drawn."""
    counts = np.bincount(ids, minlength=20)
    counts[list(hidden)] = 0
    return list(counts.tolist())


@pytest.mark.full
def test_the_browser_hides_classes(path: Path, browser: Browser) -> None:
    _, planes = read_page(path).scan(0)
    hidden = np.unique(planes["rv"])[:2].tolist()
    state = browser.state(path, f"color=error&labels=rv&hide={hidden[0]},{hidden[1]}")

    assert (state["data-color"], state["drawn"]) == ("error", count_by_class(planes["rv"], hidden))


@pytest.mark.full
@pytest.mark.parametrize(("intensity", "color"), [(0.5, "intensity"), (0.0, "height")])
def test_a_scan_without_intensity_is_not_coloured_by_it(
    intensity: float, color: str, tmp_path: Path, browser: Browser
) -> None:
    points = np.array([[1, 2, 3, intensity], [4, 5, 6, intensity]])
    path = tmp_path / "p.html"
    write_and_read(path, make_scan(points))
    assert browser.state(path, "color=intensity")["data-color"] == color


@pytest.mark.full
def test_the_browser_draws_only_wrong_or_uncertain_points(path: Path, browser: Browser) -> None:
    _, planes = read_page(path).scan(0)
    wrong = (planes["truth"] > 0) & (planes["bev"] != planes["truth"])
    state = browser.state(path, "only=wrong&labels=bev&hide=99&size=nan&color=none")

    assert state["drawn"] == count_by_class(planes["bev"][wrong])

    _, planes = read_page(path).scan(3)
    uncertain = planes["uncertain"] > 0
    state = browser.state(path, "scan=4&labels=truth&only=uncertain&color=height")

    assert (state["data-scan"], state["drawn"]) == ("3", count_by_class(planes["truth"][uncertain]))


@pytest.mark.full
def test_a_click_on_a_class_hides_it(path: Path, tmp_path: Path, browser: Browser) -> None:
    _, planes = read_page(path).scan(0)
    road = SEMANTICKITTI.classes.index("road") + 1
    button = f"document.querySelector('#classes [data-id=\"{road}\"]')"
    page = with_script(path, tmp_path / "p.html", f"{button}.click()")

    state = browser.state(page, "labels=truth")
    assert state["drawn"] == count_by_class(planes["truth"], hidden=[road])


@pytest.mark.full
def test_the_picture_shows_what_is_asked_for_at_its_place(tmp_path: Path, browser: Browser) -> None:
    """From above, x up and y to the left: cars left, green right, wrong labels at the bottom."""
    points = np.random.default_rng(0).uniform((-15, -15, -0.1, 0), (15, 15, 0.1, 1), (20_000, 4))
    truth = np.where(points[:, 1] > 0, 1, 15)
    labels = np.where(points[:, 0] > 0, truth, 13)
    path = tmp_path / "p.html"
    pages.write_page(path, [make_scan(points, truth, labels=labels)], SEMANTICKITTI, "")
    car = SEMANTICKITTI.colors[1]
    building = SEMANTICKITTI.colors[13]
    green = SEMANTICKITTI.colors[15]

    look = "size=2&camera=3.1416,1.5708,40,0,0,0"
    picture = browser.picture(path, look)
    car_rows, car_columns = pixels_of(picture, car)
    building_rows, _ = pixels_of(picture, building)
    _, green_columns = pixels_of(picture, green)

    assert car_columns.max() < green_columns.min() + 3
    assert car_rows.max() < building_rows.min() + 3

    errors = browser.picture(path, f"{look}&color=error&hide=15")
    right_rows, right_columns = pixels_of(errors, CORRECT)
    wrong_rows, _ = pixels_of(errors, WRONG_COLOR)
    assert right_columns.max() < green_columns.min() + 3
    assert right_rows.max() < wrong_rows.min() + 3
    for color in (car, building):
        rows, _ = pixels_of(errors, color)
        assert len(rows) == 0


@pytest.mark.full
def test_a_hostile_name_is_shown_and_not_run(tmp_path: Path, browser: Browser) -> None:
    hostile_page(tmp_path / "p.html")
    state = browser.state(tmp_path / "p.html")

    assert state["title"] == HOSTILE
    assert state["drawn"] is not None
    assert state["console"] == []
    assert "img" not in tags(state["dom"])


# ---- real scans, and the page of the documentation


def test_the_commands_of_the_documentation_run(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_simulation_quick(monkeypatch)
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    monkeypatch.chdir(tmp_path)
    commands = DocsPage("docs/viewing.md").commands
    run(commands, Changes(words={"sim-hdl64e": f"{world}/w.safetensors"}))
    for words in commands:
        if "--html" in words:
            assert Path(words[words.index("--html") + 1]).stat().st_size > 0
    assert len(opened) == 1
