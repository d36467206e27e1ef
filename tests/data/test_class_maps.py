"""Maps of classes: coarse ones of both benchmarks, a user's own, in predict and evaluate."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from amvnet.data.class_maps import BUILT_IN, class_map
from amvnet.data.labels.readers import read_raw_labels
from amvnet.data.taxonomy import NUSCENES, SEMANTICKITTI, Taxonomy
from amvnet.weights.file import save

from fixtures.browser_pages import read_page
from fixtures.commands import fails, new_file, refusal, refused, succeed
from fixtures.own_scans import make_own_scans, make_robot_quick
from fixtures.tiny import GOLDEN, fresh_weights, make_streets

EQUAL = {  # classes of SemanticKITTI and of nuScenes that each built-in map takes for the same
    "car": "car",
    "bicyclist": "bicycle",
    "person": "pedestrian",
    "road": "driveable_surface",
    "building": "manmade",
    "vegetation": "vegetation",
    "terrain": "terrain",
}


@pytest.mark.parametrize("taxonomy", [SEMANTICKITTI, NUSCENES])
def test_every_class_of_the_benchmarks_has_a_coarse_one(taxonomy: Taxonomy) -> None:
    table = class_map("coarse").table(taxonomy)
    assert table[0] == 0
    assert (table[1:] > 0).all()


@pytest.mark.parametrize("built_in", BUILT_IN)
def test_the_same_things_are_the_same_class_in_both_benchmarks(built_in: str) -> None:
    mapping = class_map(built_in)
    for name, other in EQUAL.items():
        train_id = mapping.table(SEMANTICKITTI)[SEMANTICKITTI.classes.index(name) + 1]
        assert train_id == mapping.table(NUSCENES)[NUSCENES.classes.index(other) + 1], name


@pytest.mark.parametrize("taxonomy", [SEMANTICKITTI, NUSCENES])
def test_both_benchmarks_have_the_seven_classes_of_lidog_and_no_two_wheelers(
    taxonomy: Taxonomy,
) -> None:
    table = class_map("lidog").table(taxonomy)
    assert set(table.tolist()) == set(range(8))
    for name, train_id in zip(taxonomy.classes, table[1:], strict=True):
        assert not (name.endswith(("cycle", "cyclist")) and train_id), name


def write_map(path: Path, classes: Any) -> Path:
    path.write_text(yaml.safe_dump({"classes": classes}))
    return path


def test_a_users_map_may_leave_classes_out_and_choose_the_ids(tmp_path: Path) -> None:
    path = write_map(tmp_path / "few.yaml", {"road": {"id": 50}, "thing": ["car", "truck"]})
    few = class_map(str(path))
    table = few.table(SEMANTICKITTI)
    assert table[SEMANTICKITTI.classes.index("road") + 1] == 1  # the name is the same
    assert table[SEMANTICKITTI.classes.index("truck") + 1] == 2
    assert table[SEMANTICKITTI.classes.index("person") + 1] == 0
    np.testing.assert_array_equal(few.target.to_raw(np.array([0, 1, 2])), [0, 50, 2])
    fails(lambda: few.table(fake_taxonomy()), "none of them")


def fake_taxonomy() -> Taxonomy:
    return Taxonomy("fake", ("cat",), ((0, 0, 0), (1, 1, 1)), {0: 0, 1: 1}, (0, 1), {}, False)


def test_a_misspelt_class_in_a_map_is_refused_by_every_command(tmp_path: Path) -> None:
    weights = save(fresh_weights(), tmp_path / "w.safetensors")
    data = make_streets(tmp_path / "data")
    out = tmp_path / "out"
    for classes, words in (
        ({"road": ["road", "parkin"]}, ("road", "found 'parkin'", "did you mean parking?")),
        ({"road": ["road"], "persn": []}, ("found 'persn'", "did you mean person?")),
    ):
        path = write_map(tmp_path / "few.yaml", classes)
        options = ("--weights", weights, "--classes", path)
        refused(("evaluate", data, *options), path, *words)
        refused(("evaluate", data, "--predictions", data, "--classes", path), path, *words)
        refused(("predict", data, *options, "--out", out), path, *words)
        assert not out.exists()


def test_a_map_may_name_classes_of_the_data_and_of_other_benchmarks(tmp_path: Path) -> None:
    path = write_map(tmp_path / "few.yaml", {"animal": ["cat"], "ground": ["driveable_surface"]})
    assert class_map(str(path), fake_taxonomy()).table(fake_taxonomy()).tolist() == [0, 1]
    fails(lambda: class_map(str(path), SEMANTICKITTI), path, "animal", "'cat'")


@pytest.mark.parametrize("kind", ["label", "npy", "csv", "ply", "pcd"])
def test_the_printed_command_shows_the_labels_of_a_map(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str
) -> None:
    weights = save(fresh_weights(), tmp_path / "w.safetensors")
    data = make_streets(tmp_path / "data")
    few = write_map(tmp_path / "few.yaml", {"car": {"id": 9}, "ground": ["road", "parking"]})
    out, page = tmp_path / "out", tmp_path / "page.html"
    options = ("--weights", weights, "--classes", few, "--out", out, "--format", kind)
    succeed("predict", data / "sequences/08/velodyne", *options)
    command = capsys.readouterr().out.partition("look at them: amvnet ")[2].splitlines()[0]
    succeed(*shlex.split(command), "--html", page)

    shown = read_page(page)
    assert shown.about["classes"] == ["unlabelled", "car", "ground"]
    written = read_raw_labels(out / f"000000.{kind}", shown.about["scans"][0]["count"], missing=0)
    ids = np.array([0, 9, 2])[shown.scan(0)[1]["labels"]]
    np.testing.assert_array_equal(ids, written)
    assert command.startswith(f"view {out}/000000.{kind}") == (kind in ("ply", "pcd"))


def test_labels_of_other_classes_than_those_that_are_shown_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_robot_quick(monkeypatch)
    data = make_own_scans(tmp_path / "robot")
    weights = save(fresh_weights(), tmp_path / "w.safetensors")
    few = write_map(tmp_path / "few.yaml", {"ground": ["road", "sidewalk"], "rest": ["car"]})
    for out, options in (("fine", ()), ("few", ("--classes", few))):
        succeed("predict", data, "--weights", weights, "--out", tmp_path / out, *options)

    view = ("view", data, "--html", tmp_path / "page.html", "--labels")
    refused((*view, tmp_path / "few"), tmp_path / "few", "give the --classes of predict")
    refused((*view, tmp_path / "few", "--classes", "coarse"), "classes of coarse", "a map made")
    refused((*view, tmp_path / "fine", "--classes", few), "leave out --classes")
    succeed(*view, tmp_path / "few", "--classes", few)
    page = read_page(tmp_path / "page.html")
    assert page.about["classes"] == ["unlabelled", "ground", "rest"]
    _, planes = page.scan(0)
    truth = np.load(tmp_path / "robot/site_a/truth/0000.npy")
    np.testing.assert_array_equal(planes["truth"], truth == 3)


def test_the_labels_of_weights_and_the_truth_are_shown_with_the_classes_of_a_map(
    tmp_path: Path,
) -> None:
    weights = save(fresh_weights(), tmp_path / "w.safetensors")
    data = make_streets(tmp_path / "data")
    pages = []
    for name, options in (("fine", ()), ("coarse", ("--classes", "coarse"))):
        path = tmp_path / f"{name}.html"
        succeed("view", data, "--weights", weights, "--html", path, *options)
        pages.append(read_page(path))
    table = class_map("coarse").table(SEMANTICKITTI)
    (_, fine), (_, coarse) = (page.scan(0) for page in pages)
    for plane in ("truth", "rv", "bev", "ensemble", "amvnet"):
        np.testing.assert_array_equal(coarse[plane], table[fine[plane]])
    assert not any(plane.endswith("probability") for plane in coarse)


@pytest.mark.parametrize(
    ("classes", "word"),
    [
        ([], "classes"),
        ({"a": ["car"], "b": ["car"]}, "car twice"),
        ({"a": [1]}, "names of classes"),
        ({"a": {"from": "car", "id": 1.5}}, "whole number"),
        ({"a": {"from": "car", "id": [1]}}, "whole number"),
        ({"a": {"from": "car", "id": 2}, "b": {"id": 2}}, "no id twice"),
        ({"a": {"color": "red"}}, "color"),
    ],
)
def test_mistakes_in_a_map_are_said_in_one_line(tmp_path: Path, classes: Any, word: str) -> None:
    path = write_map(tmp_path / "map.yaml", classes)
    fails(lambda: class_map(str(path)), path, word)


def test_predict_writes_the_ids_of_the_map_for_datasets_and_files(tmp_path: Path) -> None:
    weights = save(fresh_weights(), tmp_path / "w.safetensors")
    data = make_streets(tmp_path / "data")
    table = class_map("coarse").table(SEMANTICKITTI)
    scans = data / "sequences/08/velodyne"
    for inputs, inner in ((data, "sequences/08/predictions"), (scans, ".")):
        fine = tmp_path / f"fine-{inputs.name}"
        coarse = tmp_path / f"coarse-{inputs.name}"
        for out, options in ((fine, []), (coarse, ["--classes", "coarse"])):
            succeed("predict", inputs, "--weights", weights, "--out", out, *options)
        raw = np.fromfile(fine / inner / "000000.label", np.uint32)
        expected = table[SEMANTICKITTI.to_train(raw)]
        found = np.fromfile(coarse / inner / "000000.label", np.uint32)
        np.testing.assert_array_equal(found, expected)

    message = refusal(f"predict {data} --weights {weights} --out {tmp_path / 'o'} --classes coars")
    assert "expected coarse, lidog or a YAML file" in message


def test_weights_of_one_benchmark_are_scored_on_the_other_by_coarse_classes(tmp_path: Path) -> None:
    # Rows by elevation, as the weights of KITTI have them.
    weights = save(fresh_weights(), tmp_path / "w.safetensors")
    figures = tmp_path / "figures.json"
    succeed(
        *("evaluate", f"nuscenes:{GOLDEN / 'nuscenes'}", "--weights", weights),
        *("--classes", "coarse", "--split", "all", "--json", figures),
    )
    report = json.loads(figures.read_text())["methods"]["amvnet"]
    assert list(report["iou"]) == list(class_map("coarse").target.classes)


def test_scores_of_coarse_classes_are_those_of_mapped_labels(tmp_path: Path) -> None:
    data = make_streets(tmp_path / "data")
    labels = sorted((data / "sequences/08/labels").glob("*.label"))
    wrong = {10: 18, 48: 50}  # cars as trucks are the same coarse class; sidewalk as building not
    matrix = np.zeros(4, dtype=np.int64)  # points of ground: right, missed; building: right, wrong
    for path in labels:
        raw = np.fromfile(path, np.uint32)
        predicted = raw.copy()
        for truth, mistake in wrong.items():
            predicted[raw == truth] = mistake
        target = tmp_path / "out/sequences/08/predictions" / path.name
        target.parent.mkdir(parents=True, exist_ok=True)
        predicted.tofile(target)
        matrix += [(raw == value).sum() for value in (40, 48, 50, 48)]

    figures = tmp_path / "figures.json"
    succeed(
        *("evaluate", data, "--predictions", tmp_path / "out"),
        *("--classes", "coarse", "--json", figures),
    )
    iou = json.loads(figures.read_text())["methods"]["predictions"]["iou"]
    assert iou["vehicle"] == 1
    assert iou["ground"] == pytest.approx(matrix[0] / (matrix[0] + matrix[1]))
    assert iou["building"] == pytest.approx(matrix[2] / (matrix[2] + matrix[3]))


def test_labels_that_predict_wrote_with_a_map_are_scored_with_the_same_map_alone(
    tmp_path: Path,
) -> None:
    data = make_streets(tmp_path / "data")
    weights = save(fresh_weights(), tmp_path / "w.safetensors")
    swap = {"building": {"from": ["road", "car"], "id": 40}, "road": {"from": ["building"]}}
    few = write_map(tmp_path / "few.yaml", swap)
    out, figures = tmp_path / "out", tmp_path / "figures.json"
    succeed("predict", data, "--weights", weights, "--classes", few, "--out", out)
    reports = []
    for labels in (("--weights", weights), ("--predictions", out)):
        succeed(*("evaluate", data, *labels, "--classes", few), *("--json", figures, "--overwrite"))
        reports.append(json.loads(figures.read_text())["methods"])
    assert reports[0]["amvnet"] == reports[1]["predictions"]
    for options in ([], ["--classes", "coarse"]):
        refused(("evaluate", data, "--predictions", out, *options), "the --classes of predict")


def test_a_point_whose_predicted_class_the_map_does_not_name_is_wrong(tmp_path: Path) -> None:
    data = make_streets(tmp_path / "data")
    few = write_map(tmp_path / "few.yaml", {"ground": ["road", "sidewalk"], "house": ["building"]})
    points = wrong = 0
    for path in (data / "sequences/08/labels").glob("*.label"):
        raw = np.fromfile(path, np.uint32)
        points += np.isin(raw, (40, 48, 50)).sum()
        wrong += (raw == 48).sum()
        raw[raw == 48] = 10  # sidewalk as cars
        target = tmp_path / "out/sequences/08/predictions" / path.name
        target.parent.mkdir(parents=True, exist_ok=True)
        raw.tofile(target)
    assert wrong

    figures = tmp_path / "figures.json"
    options = ("--predictions", tmp_path / "out", "--classes", few, "--json", figures)
    succeed("evaluate", data, *options)
    report = json.loads(figures.read_text())["methods"]["predictions"]
    assert (report["accuracy"], report["iou"]["house"]) == (pytest.approx(1 - wrong / points), 1)


def test_classes_that_are_not_scored_are_said_with_their_share(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    make_robot_quick(monkeypatch)
    data = make_own_scans(tmp_path / "robot")
    truths = []
    for path in (tmp_path / "robot/site_c/truth").glob("*.npy"):
        truths.append(np.load(path))
        truths[-1][:9] = 7
        np.save(path, truths[-1])
    truth = np.concatenate(truths)
    lost = np.isin(truth, (7, 21)).sum() / (truth != -1).sum()
    weights = save(fresh_weights(), tmp_path / "w.safetensors")
    succeed("evaluate", data, "--weights", weights, "--classes", "coarse")
    printed = capsys.readouterr().out
    assert f"not scored: plant, structure ({lost:.0%} of the labelled points)" in printed
    assert "which coarse does not name" in printed
    streets = make_streets(tmp_path / "data")
    succeed("evaluate", streets, "--weights", weights, "--classes", "coarse")
    assert "not scored" not in capsys.readouterr().out


def test_two_classes_of_one_name_are_refused(tmp_path: Path) -> None:
    path = new_file(tmp_path / "few.yaml", "classes: {ground: [road], 'ground': [car]}")
    fails(lambda: class_map(str(path)), path, "the key 'ground' twice")


@pytest.mark.parametrize("name", ["no", "on", "1", "1.5", "null"])
def test_a_name_that_yaml_reads_as_another_value_needs_quotes(tmp_path: Path, name: str) -> None:
    path = new_file(tmp_path / "few.yaml", f"classes: {{{name}: [road]}}")
    fails(lambda: class_map(str(path)), path, "quotes")
    path.write_text(f"classes: {{'{name}': [road]}}")
    assert class_map(str(path)).target.classes == (name,)
