"""What `import amvnet` offers: its names, its types, short descriptions, and results to use."""

from __future__ import annotations

import os
import pydoc
import re
import subprocess
import sys
import textwrap
import webbrowser
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import amvnet
from amvnet import InputError, Scan, Segmentation, Segmenter
from amvnet.data.formats.find import read_cloud
from amvnet.data.labels.writers import KINDS
from amvnet.data.taxonomy import NUSCENES, SEMANTICKITTI
from amvnet.weights.file import save

from fixtures.browser_pages import read_page
from fixtures.commands import fails, files, not_none, succeed
from fixtures.scan_writers import write_bag1, write_pcd
from fixtures.tiny import fresh_weights, make_streets, street, without

WEIGHTS = fresh_weights()
POINTS = np.clip(street(3, 500)[0], -60, 60)


@pytest.fixture(scope="module")
def segmenter() -> Segmenter:
    return amvnet.load(WEIGHTS)


@pytest.fixture(scope="module")
def result(segmenter: Segmenter) -> Segmentation:
    return segmenter(POINTS)


# ---- names


def test_dir_shows_what_is_public_and_nothing_else() -> None:
    modules = {"onnx_runner", "weights"}
    assert set(dir(amvnet)) == {*amvnet.__all__, *modules, "__doc__", "__version__"}
    for name in dir(amvnet):
        assert getattr(amvnet, name) is not None


def test_help_shows_what_is_public_and_nothing_else() -> None:
    text = pydoc.plain(pydoc.render_doc(amvnet))
    assert set(re.findall(r"^    (?:class )?(\w+)\(.*\)", text, re.M)) == set(amvnet.__all__)
    assert "import_module" not in text
    assert "TYPE_CHECKING" not in text


@pytest.mark.parametrize(
    ("module", "slow"),
    [("amvnet", {"torch", "numpy"}), ("amvnet.cli.main", {"torch", "lightning", "matplotlib"})],
)
def test_importing_loads_no_slow_library(module: str, slow: set[str]) -> None:
    code = f"import {module}, sys; dir(amvnet); print(({slow} | {{'scipy'}}) & set(sys.modules))"
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout
    assert printed.strip() == b"set()"


# ---- reading


def test_read_gives_the_scan_of_a_file_as_it_is(tmp_path: Path) -> None:
    POINTS.tofile(tmp_path / "a.bin")
    write_pcd(tmp_path / "b.pcd", POINTS, "binary")
    for name in ("a.bin", "b.pcd"):
        np.testing.assert_array_equal(amvnet.read(tmp_path / name).points, POINTS)
    assert isinstance(amvnet.read(str(tmp_path / "a.bin")), Scan)


def test_read_all_gives_the_scans_of_a_folder_a_bag_and_a_dataset(tmp_path: Path) -> None:
    (tmp_path / "scans").mkdir()
    for name in ("a", "b", "c"):
        POINTS[ord(name) - 90 :].tofile(tmp_path / f"scans/{name}.bin")
    scans = amvnet.read_all(tmp_path / "scans")
    assert [len(scan) for scan in scans] == [493, 492, 491]
    assert [len(scan) for scan in scans[1:]] == [492, 491]
    assert len(scans[-1]) == 491

    write_bag1(tmp_path / "drive.bag", {"/lidar": [POINTS, POINTS[:100]], "/other": [POINTS]})
    scans = amvnet.read_all(tmp_path / "drive.bag", topic="/lidar")
    assert [len(scan) for scan in scans] == [500, 100]
    fails(lambda: amvnet.read(tmp_path / "drive.bag", topic="/lidar"), "2", "amvnet.read_all")
    assert len(amvnet.read(tmp_path / "drive.bag", topic="/other")) == 500

    scans = amvnet.read_all(make_streets(tmp_path / "data", ("00",)))
    assert scans[0].labels is not None
    assert len(scans) == 2


def test_a_missing_file_is_one_line(tmp_path: Path, segmenter: Segmenter) -> None:
    missing = tmp_path / "missing.bin"
    fails(lambda: amvnet.read(missing), missing)
    fails(lambda: segmenter(missing), missing)


# ---- segmenting files


def test_a_path_is_segmented_as_by_predict(tmp_path: Path, segmenter: Segmenter) -> None:
    save(WEIGHTS, tmp_path / "w.safetensors")
    moved = POINTS + np.array([0, 0, 0.6, 0], np.float32)
    (tmp_path / "scans").mkdir()
    write_pcd(tmp_path / "scans/a.pcd", moved * np.array([1, 1, 1, 255], np.float32), "binary")
    write_pcd(tmp_path / "scans/b.pcd", moved[::-1].copy(), "binary")
    scans = tmp_path / "scans"
    succeed(f"predict {scans} --weights {tmp_path}/w.safetensors --format ply --out {tmp_path}/out")

    results = list(segmenter.each(scans))
    for name, each in zip(("a", "b"), results, strict=True):
        each.save(tmp_path / f"{name}.ply")
        assert (tmp_path / f"{name}.ply").read_bytes() == (
            tmp_path / f"out/{name}.ply"
        ).read_bytes()

    alone = segmenter(str(scans / "a.pcd"))
    assert "assumed intensity" in alone.assumed
    assert len(alone) == len(POINTS)
    fails(lambda: segmenter(scans), "2", "Segmenter.each")
    paths: Any = [scans / "a.pcd", str(scans / "b.pcd")]
    for wrong in (partial(segmenter, paths), lambda: segmenter.many([*paths])):
        fails(wrong, "scan: expected points", "a.pcd", "Segmenter.each")
    for one, other in zip(segmenter.each(paths), results, strict=True):
        assert np.array_equal(one.labels, other.labels)


def test_a_scan_of_a_dataset_keeps_its_labels(tmp_path: Path, segmenter: Segmenter) -> None:
    data = make_streets(tmp_path, ("00",))
    fails(lambda: segmenter(data), "one scan", "Segmenter.each")
    first = next(segmenter.each(data))
    assert not_none(first.origin).scan.labels is not None
    assert first.assumed == ""


# ---- results


def test_names_colours_and_raw_ids_are_aligned_with_ids(result: Segmentation) -> None:
    assert result.class_names == ("unlabelled", *SEMANTICKITTI.classes)
    assert result.colors.shape == (20, 3)
    assert result.colors[result.class_names.index("car")].tolist() == [100, 150, 245]

    expected = np.asarray(SEMANTICKITTI.train_to_raw)[result.labels]
    np.testing.assert_array_equal(result.raw_ids, expected)
    assert result.raw_ids.dtype == np.uint32


@pytest.mark.parametrize("kind", KINDS)
def test_the_ending_decides_the_format(kind: str, result: Segmentation, tmp_path: Path) -> None:
    path = result.save(tmp_path / f"new/a.b.{kind}")
    assert files(tmp_path) == {f"new/a.b.{kind}"}
    if kind == "label":
        np.testing.assert_array_equal(np.fromfile(path, np.uint32), result.raw_ids)
    elif kind == "npy":
        np.testing.assert_array_equal(np.load(path, allow_pickle=False), result.raw_ids)
    else:
        np.testing.assert_allclose(read_cloud(path).xyz, POINTS[:, :3], atol=6e-4)


def test_counts_masks_and_points_are_of_the_labels(result: Segmentation) -> None:
    np.testing.assert_array_equal(result.points, POINTS[:, :3])
    counts = result.counts()
    assert sum(counts.values()) == len(result)
    assert list(counts.values()) == sorted(counts.values(), reverse=True)
    for name, count in counts.items():
        index = result.class_names.index(name)
        assert result.mask(name).sum() == count == (result.labels == index).sum()
    np.testing.assert_array_equal(result.mask(*counts), np.ones(len(result), bool))
    assert not result.mask().any()
    two = list(counts)[:2]
    np.testing.assert_array_equal(result.mask(two), result.mask(*two))
    np.testing.assert_array_equal(result.mask(np.array(two)), result.mask(*two))
    fails(lambda: result.mask(["cat"]), "'cat'", "did you mean car")
    fails(lambda: result.mask("cat"), "'cat'", "did you mean car")


@pytest.mark.parametrize("name", ["a", "a.txt", "a.PLY", "a.bin", ".ply"])
def test_another_ending_is_named(name: str, result: Segmentation, tmp_path: Path) -> None:
    fails(lambda: result.save(tmp_path / name), ".ply", ".label")
    assert not files(tmp_path)


def test_a_scan_is_never_replaced_by_its_labels(tmp_path: Path, segmenter: Segmenter) -> None:
    write_pcd(tmp_path / "a.ply", POINTS, "binary")
    before = (tmp_path / "a.ply").read_bytes()
    result = segmenter(tmp_path / "a.ply")
    assert result.save(tmp_path / "b.ply") == tmp_path / "b.ply"
    labelled = segmenter(amvnet.read(tmp_path / "b.ply"))
    fails(partial(labelled.save, tmp_path / "b.ply"), "b.ply", "found the input")
    (tmp_path / "link.ply").symlink_to(tmp_path / "a.ply")
    os.link(tmp_path / "a.ply", tmp_path / "hard.ply")
    for name in ("a.ply", "link.ply", "hard.ply", "../" + tmp_path.name + "/a.ply"):
        fails(partial(result.save, tmp_path / name), "a.ply", "found the input")
    assert (tmp_path / "a.ply").read_bytes() == before
    assert (tmp_path / "link.ply").is_symlink()


def test_labels_replace_earlier_labels_alone(result: Segmentation, tmp_path: Path) -> None:
    for kind in KINDS:
        path = result.save(tmp_path / f"a.{kind}")
        before = path.read_bytes()
        assert result.save(path).read_bytes() == before
        path.write_bytes(b"PK something else")
        fails(partial(result.save, path), path, "found another file")
        assert path.read_bytes() == b"PK something else"


def test_show_writes_a_page_and_opens_it(
    segmenter: Segmenter, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    points, raw = street(3, 500)
    points[7] = np.nan
    result = segmenter(Scan(points, SEMANTICKITTI.to_train(raw), name="my <scan>"))

    path = amvnet.show(result, tmp_path / "p.html")
    assert opened == [path.as_uri()]
    _, planes = read_page(path).scan(0)
    is_valid = np.arange(len(points)) != 7
    np.testing.assert_array_equal(planes["amvnet"], result.labels[is_valid])
    np.testing.assert_array_equal(planes["truth"], SEMANTICKITTI.to_train(raw)[is_valid])
    np.testing.assert_array_equal(planes["uncertain"], result.uncertain[is_valid])
    for name, scores in (("rv", result.rv), ("bev", result.bev)):
        assert scores is not None
        np.testing.assert_array_equal(planes[name], scores[is_valid].argmax(axis=1) + 1)


def test_show_takes_points_and_adds_the_ending_of_a_page(tmp_path: Path) -> None:
    for points in (POINTS, Scan(POINTS), POINTS.tolist()):
        path = amvnet.show(points, tmp_path / "v", open_browser=False)
        assert path == tmp_path / "v.html"
        xyz, planes = read_page(path).scan(0)
        assert len(xyz) == len(POINTS)
        assert set(planes) == {"intensity"}
    fails(lambda: amvnet.show(POINTS * np.nan, tmp_path / "n"), "expected points")
    for folder in ("", ".", "..", "/"):
        fails(partial(amvnet.show, POINTS, folder, open_browser=False), "found a folder")


def test_the_listed_weights_can_be_loaded() -> None:
    for name in amvnet.list_weights():
        assert amvnet.weights.load(name).parts == ("range_net", "polar_net", "point_head")


def test_show_needs_no_path_and_no_browser(segmenter: Segmenter) -> None:
    path = amvnet.show(amvnet.load(WEIGHTS, method="bev")(POINTS), open_browser=False)
    _, planes = read_page(path).scan(0)
    assert "bev" in planes
    assert "uncertain" not in planes


def test_the_late_fusion_alone_says_that_it_knows_no_classes(result: Segmentation) -> None:
    bare = Segmentation(result.labels, result.uncertain, result.scores)
    assert bare.verdict is None
    assert repr(bare) == "<Segmentation of 500 points>"
    fails(lambda: bare.raw_ids, "Segmenter")
    fails(lambda: bare.save("a.ply"), "Segmenter")


# ---- descriptions


def test_descriptions_are_short(segmenter: Segmenter, result: Segmentation) -> None:
    scan = Scan(POINTS, np.zeros(500, np.uint8), np.zeros(500, np.int64), "a.bin")
    assert repr(scan) == "<Scan a.bin: 500 points, labels, rings>"
    assert repr(Scan(POINTS)) == "<Scan: 500 points>"
    weights = "<Weights for tiny: range_net, polar_net, point_head; 19 classes of semantickitti>"
    assert repr(WEIGHTS) == weights
    assert repr(without(WEIGHTS, "range_net", "point_head")).startswith("<Weights for tiny: polar")
    assert repr(fresh_weights(NUSCENES)).endswith("16 classes of nuscenes>")
    assert repr(segmenter) == f"<Segmenter amvnet on cpu, float32: {weights}>"

    text = repr(result)
    assert re.fullmatch(r"<Segmentation of 500 points: .*; \d+\.\d% uncertain.*>", text)
    most_frequent = result.class_names[np.bincount(result.labels).argmax()]
    assert f": {np.mean(result.labels == result.labels.max()):.0%}" in text or most_frequent in text
    assert len(text) < 150


# ---- types


SCRIPT = """
from pathlib import Path
from typing import Any

import numpy as np

import amvnet


def segment(path: Path) -> float:
    segmenter = amvnet.load("sim-hdl64e", method="ensemble")
    scan: amvnet.Scan = amvnet.read(path)
    result: amvnet.Segmentation = segmenter(scan)
    for each in segmenter.each(path, topic="/lidar"):
        print(repr(each), each.verdict)
    for other in amvnet.read_all(path)[1:]:
        print(len(other))
    first, second = segmenter.many([scan, np.zeros((3, 4), np.float32)])
    saved: Path = segmenter(path).save("a.ply")
    page: Path = amvnet.show(first, saved)
    amvnet.show(scan.points, open_browser=False)
    print(amvnet.list_weights()[0], first.counts()["car"], first.points[first.mask("car")])
    names: list[str] = [second.class_names[index] for index in result.labels]
    rgb = result.colors[result.labels]
    print(page, names, rgb.shape, result.raw_ids.tolist(), amvnet.__version__)
    if result.rv is not None and result.bev is not None:
        labels = amvnet.fuse(scan.points, result.rv, result.bev, head="sim-hdl64e")
        print(labels.shape)
    weights: amvnet.Weights = amvnet.weights.load("sim-hdl64e")
    print(amvnet.load(weights).taxonomy.classes)
    amvnet.simulate(Path("streets"), sensor="hdl32e", seed=3)
    try:
        return float(result.uncertain.mean())
    except amvnet.InputError as error:
        print(error)
        return 0.0
"""
WRONG = {
    'amvnet.lod("sim-hdl64e")': "attr-defined",
    'amvnet.load("sim-hdl64e", method="both")': "arg-type",
    "amvnet.load(5)": "arg-type",
    'amvnet.load("sim-hdl64e")(5)': "arg-type",
    'amvnet.load("sim-hdl64e").meny([])': "attr-defined",
    "amvnet.import_module": "attr-defined",
}
# Large packages whose types a user's script does not touch: without them mypy takes seconds.
SKIPPED = ("torch", "scipy", "yaml", "safetensors", "laspy", "rosbags", "huggingface_hub")


@pytest.mark.full
def test_a_users_script_passes_strict_types_and_mistakes_do_not(tmp_path: Path) -> None:
    assert (resources.files("amvnet") / "py.typed").is_file()
    (tmp_path / "script.py").write_text(SCRIPT)
    mistakes = "".join(f"{line}\n" for line in WRONG)
    (tmp_path / "wrong.py").write_text(f"import amvnet\n{mistakes}")

    sections = "".join(f"[mypy-{name}.*]\nfollow_imports = skip\n" for name in SKIPPED)
    settings = f"""
        [mypy]
        strict = True
        follow_imports = silent
        mypy_path = {Path(amvnet.__file__).parents[1]}
        cache_dir = {tmp_path}/cache
    """
    (tmp_path / "mypy.ini").write_text(textwrap.dedent(settings) + sections)
    command = [sys.executable, "-m", "mypy", "script.py", "wrong.py"]
    printed = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)

    errors = re.findall(r"^(\S+?):(\d+): error: .*\[([\w-]+)\]$", printed.stdout, re.M)
    expected = [("wrong.py", str(line), code) for line, code in enumerate(WRONG.values(), start=2)]
    assert errors == expected, printed.stdout + printed.stderr
    assert isinstance(InputError("a"), ValueError)
