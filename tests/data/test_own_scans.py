"""A user's own scans: places of labels, splits, classes, and files with mistakes."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
import yaml

from amvnet.data.datasets.open import open_dataset
from amvnet.data.datasets.own import OwnScans, open_own
from amvnet.data.datasets.training_data import to_mix_in, to_train
from amvnet.data.labels.readers import read_scan_labels
from amvnet.data.taxonomy import SEMANTICKITTI, Taxonomy
from amvnet.errors import InputError

from fixtures.commands import fails, new_file, run_cli
from fixtures.scan_writers import some_points, write_las, write_ply

RAW = np.random.default_rng(1).choice([3, 7, 40], 60)
EXPECTED = np.select([RAW == 3, RAW == 7], [1, 2], 0)  # 40 is ignored
BASE: dict[str, Any] = {
    "classes": {"ground": 3, "plant": [7, 8]},
    "ignored": [40, -1],
    "scans": "*/*.npy",
    "labels": ".label",
}


def describe(folder: Path, **changes: Any) -> Path:
    tree = {**BASE, **changes}
    path = folder / "own.yaml"
    path.write_text(yaml.safe_dump({key: value for key, value in tree.items() if value}))
    return path


def only_scan(folder: Path, **changes: Any) -> np.ndarray | None:
    data = open_dataset(f"files:{describe(folder, **changes)}")
    (record,) = data.records(data.sequences("all"))
    scan = data.read(record)
    assert len(scan) == len(RAW)
    return scan.labels


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A folder with one scan, a.npy."""
    (tmp_path / "site").mkdir()
    np.save(tmp_path / "site/a.npy", some_points())
    return tmp_path / "site"


def test_a_missing_yaml_file_is_not_called_a_folder(tmp_path: Path) -> None:
    path = tmp_path / "own.yaml"
    fails(lambda: open_dataset(str(path)), path, "(YAML), found no such file; check the path")


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.uint32, np.int64])
def test_labels_are_integers_of_any_size(site: Path, dtype: type[np.integer[Any]]) -> None:
    RAW.astype(dtype).tofile(site / "a.label")
    np.testing.assert_array_equal(only_scan(site.parent), EXPECTED)


def test_labels_are_read_from_every_kind_of_file_and_field(site: Path) -> None:
    points = some_points()
    np.savez(site / "z.npz", points=points, semantic=RAW)
    labels = only_scan(site.parent, scans="site/*.npz", labels={"field": "semantic"})
    np.testing.assert_array_equal(labels, EXPECTED)

    table = np.column_stack([points, RAW])
    np.savetxt(site / "t.csv", table, delimiter=",", header="x,y,z,intensity,kind", comments="")
    labels = only_scan(site.parent, scans="site/t.csv", labels={"field": "kind"})
    np.testing.assert_array_equal(labels, EXPECTED)

    table.astype(np.float32).tofile(site / "b.bin")
    rows = {"columns": ["x", "y", "z", "intensity", "kind"], "dtype": "float32"}
    labels = only_scan(site.parent, scans="site/*.bin", labels={"field": "kind"}, **rows)
    np.testing.assert_array_equal(labels, EXPECTED)

    las = laspy.read(write_las(site / "l.las", points))
    las.classification = RAW % 32  # 40 becomes 8, a plant
    for ending in ("las", "laz"):
        las.write(str(site / f"l.{ending}"))
        labels = only_scan(
            site.parent, scans=f"site/*.{ending}", labels={"field": "classification"}
        )
        np.testing.assert_array_equal(labels, np.where(RAW == 3, 1, 2))

    write_ply(site / "p.ply", points)
    for name, write in (
        ("p.npy", lambda path: np.save(path, RAW[:, None])),
        ("p.npz", lambda path: np.savez(path, labels=RAW, other=points)),
        ("p.txt", lambda path: np.savetxt(path, RAW, fmt="%d")),
        ("p.txt", lambda path: np.savetxt(path, RAW)),  # with exponents
        ("p.csv", lambda path: np.savetxt(path, RAW, fmt="%d", header="label", comments="")),
    ):
        write(site / name)
        labels = only_scan(site.parent, scans="site/*.ply", labels=Path(name).suffix)
        np.testing.assert_array_equal(labels, EXPECTED, err_msg=name)


def test_scans_without_a_label_file_are_left_out_of_the_training(tmp_path: Path) -> None:
    for site in ("a", "b"):
        (tmp_path / site).mkdir()
        for index in range(3):
            np.save(tmp_path / f"{site}/{index}.npy", some_points(seed=index))
    for labelled in ("a/0", "b/1"):
        RAW.astype(np.uint32).tofile(tmp_path / f"{labelled}.label")

    data = open_own(describe(tmp_path))
    assert data.read(data.records(["a"])[1]).labels is None
    scans = to_train(data)
    assert [record.name for record in scans.train] == ["a/0"]
    assert [record.name for record in scans.val] == ["b/1"]

    # Without labels, b does not validate: a is left alone.
    (tmp_path / "b/1.label").unlink()
    fails(lambda: to_train(data_of(tmp_path)), "two sequences", "a alone", "under split")
    first = tmp_path / "b/0.label"  # that was looked for
    fails(lambda: to_train(data_of(tmp_path), None, ["b"]), "labelled scans", first, "other 2")


def data_of(folder: Path) -> OwnScans:
    return open_own(folder / "own.yaml")


def test_splits_are_folders_patterns_or_lists_and_may_cut_through_a_folder(tmp_path: Path) -> None:
    for site in ("a", "b", "c"):
        (tmp_path / site).mkdir()
        for index in range(4):
            np.save(tmp_path / f"{site}/{index}.npy", some_points())
    data = open_own(describe(tmp_path, split={"train": ["a", "b/[23]"], "val": ["b/0.npy", "b/1"]}))

    assert (data.sequences("train"), data.sequences("val")) == (("a", "b-train"), ("b-val",))
    assert [record.name for record in data.records(["b-val"])] == ["b/0", "b/1"]
    assert data.sequences("all") == ("a", "b-train", "b-val", "c")
    assert data.records(["b"]) == data.records(["b-train", "b-val"])

    both = describe(tmp_path, split={"train": "a", "val": "a/0"})
    fails(lambda: open_own(both), "a/0", "train and val")


def sites(folder: Path, split: dict[str, Any] | None = None, labelled: str = "abcd") -> OwnScans:
    """Return a dataset of two scans in each of the sites a, b, c and d."""
    for site in "abcd":
        (folder / site).mkdir(exist_ok=True)
        for index in range(2):
            np.save(folder / f"{site}/{index}.npy", some_points(seed=index))
            if site in labelled:
                RAW.astype(np.uint32).tofile(folder / f"{site}/{index}.label")
    return open_own(describe(folder, split=split))


def sequences_of(data: OwnScans) -> tuple[set[str], set[str]]:
    scans = to_train(data)
    return {record.sequence for record in scans.train}, {record.sequence for record in scans.val}


@pytest.mark.parametrize(
    ("split", "train", "val"),
    [
        ({"train": ["a", "b"], "val": "c"}, "ab", "c"),
        ({"val": "c", "test": "b"}, "ad", "c"),
        ({"val": "c"}, "abd", "c"),
        (None, "abc", "d"),
    ],
)
def test_what_is_trained_on_follows_from_the_split(
    tmp_path: Path, split: dict[str, Any] | None, train: str, val: str
) -> None:
    data = sites(tmp_path, split)
    assert sequences_of(data) == (set(train), set(val))
    # Every command validates with the same scans.
    assert data.sequences("val") == tuple(val)
    given = data.split()
    assert (given.part("rest") if given.is_given else ()) == (("d",) if train == "ab" else ())


@pytest.mark.parametrize(
    ("split", "words"),
    [
        ({"train": ["a"], "val": "x"}, ("split: val", "'x'", "a, b, c, d")),
        ({"train": ["a", "x"], "val": "c"}, ("split: train", "'x'")),
        ({"train": "train.lst", "val": "val.lst"}, ("split: train", "'train.lst'")),
        ({"train": "a", "val": []}, ("split: val", "none")),
        ({"train": "a", "val": "b", "test": "c/2*"}, ("split: test", "'c/2*'")),
    ],
)
def test_an_entry_of_the_split_without_scans_is_refused(
    tmp_path: Path, split: dict[str, Any], words: tuple[str, ...]
) -> None:
    fails(lambda: sites(tmp_path, split), "own.yaml", *words)


def test_a_split_without_val_is_not_replaced_by_the_default(tmp_path: Path) -> None:
    data = sites(tmp_path, {"train": ["a", "b"]})
    fails(lambda: to_train(data), "split val", "only train")
    assert {record.sequence for record in to_train(data, None, ["c"]).train} == {"a", "b"}
    assert {record.sequence for record in to_train(data, with_val=True).train} == {"a", "b"}


def test_test_scans_are_never_trained_on(tmp_path: Path) -> None:
    data = sites(tmp_path, {"val": "c", "test": "b"})
    fails(lambda: to_train(data, ["a", "b"], None), "test split", "found b")
    for with_val in (False, True):
        assert "b" not in {record.sequence for record in to_train(data, with_val=with_val).train}
    assert "b" not in {record.sequence for record in to_mix_in(data).train}


def test_the_default_split_validates_with_the_last_sequence_that_has_labels(tmp_path: Path) -> None:
    assert sequences_of(sites(tmp_path, labelled="abc")) == ({"a", "b"}, {"c"})


def test_named_sequences_are_not_used_for_the_other_purpose(tmp_path: Path) -> None:
    data = sites(tmp_path)
    assert {record.sequence for record in to_train(data, None, ["a"]).train} == {"b", "c", "d"}
    fails(lambda: to_train(data, ["d"], None), "two sequences", "name them")


def test_evaluate_scores_the_val_scans(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sites(tmp_path)
    predictions = tmp_path / "predictions/d"
    predictions.mkdir(parents=True)
    for index in range(2):
        RAW.astype(np.uint32).tofile(predictions / f"{index}.label")
    command = ("evaluate", tmp_path / "own.yaml", "--predictions", predictions.parent)
    assert run_cli(*command) == (0, "")
    assert "2 scans of d" in capsys.readouterr().out


@pytest.mark.parametrize("ignored", ["rest", ["rest"], [40, "rest"]])
def test_the_rest_of_the_ids_can_be_ignored(site: Path, ignored: Any) -> None:
    np.where(RAW == 40, np.arange(60) + 1000, RAW).astype(np.uint32).tofile(site / "a.label")
    np.testing.assert_array_equal(only_scan(site.parent, ignored=ignored), EXPECTED)

    # Weights, which carry the classes, do not name 65,536 ids.
    taxonomy = open_own(site.parent / "own.yaml").taxonomy
    assert len(Taxonomy.from_dict(taxonomy.to_dict()).raw_to_train) < 6


def test_ids_before_names_are_told_to_come_after_them(site: Path) -> None:
    path = new_file(site.parent / "own.yaml", "classes: {0: ground, 1: plant}\nscans: '*/*.npy'\n")
    fails(lambda: open_own(path), path, "found 0: 'ground'", "write the name first")


@pytest.mark.parametrize("text", ["{no: 1, b: 2}", "{1: 1, b: 2}", "{a: 1, b: 2, 'a': 3}"])
def test_names_that_yaml_changes_or_drops_are_refused(site: Path, text: str) -> None:
    path = new_file(site.parent / "own.yaml", f"classes: {text}\nscans: '*/*.npy'\n")
    fails(lambda: open_own(path), path, "twice" if "'a'" in text else "quotes")


def test_the_classes_that_differ_are_named(tmp_path: Path) -> None:
    spec = str(sites(tmp_path).spec)
    for names, words in (
        (("ground", "tree"), ("without 'plant'", "with 'tree'")),
        (("plant", "ground"), ("another order",)),
        (("ground", "plant", "car"), ("with 'car'",)),
    ):
        ids = tuple(range(len(names) + 1))
        colors = ((0, 0, 0),) * len(ids)
        weights = Taxonomy("own", names, colors, dict(enumerate(ids)), ids, {}, False)
        own = open_dataset(spec, weights)
        fails(partial(own.labelled, own.records(own.sequences("all"))), "own.yaml", *words)


@pytest.mark.parametrize("labels", [".truth.npy", "{name}_labels.npy"])
def test_label_files_that_match_the_pattern_of_scans_are_no_scans(site: Path, labels: str) -> None:
    np.save(site / f"a{labels.removeprefix('{name}')}", RAW)
    np.testing.assert_array_equal(only_scan(site.parent, labels=labels), EXPECTED)

    # Nor for weights of other classes, for which their ids would mean others.
    data = open_own(str(site.parent / "own.yaml")).with_classes(SEMANTICKITTI)
    (record,) = data.records(data.sequences("all"))
    assert record.name == "site/a"
    assert data.taxonomy == SEMANTICKITTI
    assert record.labels_path is None
    assert data.read(record).labels is None
    fails(lambda: data.labelled([record]), "weights with the classes of the data")


def test_predictions_of_other_ids_are_told_which_to_write(site: Path) -> None:
    np.save(site / "a.npy", np.column_stack([some_points()[:, :3], RAW]))
    data = open_own(describe(site.parent, labels={"field": 3}))
    (record,) = data.records(["site"])
    path = site.parent / "predictions" / record.prediction
    path.parent.mkdir(parents=True)
    np.resize(np.array([0, 1, 2], np.uint32), data.count_points(record)).tofile(path)
    call = partial(data.read_prediction, record, site.parent / "predictions")
    fails(call, path, "(3, 7), found 0, 1, 2", "write the predictions with these ids")


def test_predictions_come_back_as_the_users_ids(site: Path, tmp_path: Path) -> None:
    data = open_own(describe(tmp_path))
    (record,) = data.records(["site"])
    path = data.write_labels(record, tmp_path / "out", data.read(record), EXPECTED)
    assert path == tmp_path / "out/site/a.label"
    np.testing.assert_array_equal(np.fromfile(path, np.uint32), RAW)
    np.testing.assert_array_equal(data.read_prediction(record, tmp_path / "out"), EXPECTED)


@pytest.mark.parametrize("number", ["1:30", "1:30.5", "01", "1_0"])
def test_what_yaml_alone_takes_for_a_number_is_refused_as_a_number(site: Path, number: str) -> None:
    path = describe(site.parent, classes=None)
    text = path.read_text()
    path.write_text(f"{text}classes: {{ground: {number}}}\n")
    fails(lambda: open_own(path), path.name, "whole numbers", repr(number))


@pytest.mark.parametrize("name", ["07", "010", "2011_09_26", "2024-05-01", "12:30", "7"])
def test_folders_may_be_named_as_numbers_and_dates(tmp_path: Path, name: str) -> None:
    """YAML 1.1 reads 010 as 8 and 2011_09_26 as 20110926."""
    for folder in (name, "b"):
        (tmp_path / folder).mkdir()
        np.save(tmp_path / folder / "a.npy", some_points())
    path = describe(tmp_path)
    text = path.read_text()
    path.write_text(f"{text}split: {{train: [{name}], val: b}}\n")
    assert open_own(path).sequences("train") == (name,)


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"classes": [1, 2]}, "road: [1, 2]"),
        ({"classes": {"a": "road"}}, "'road'"),
        ({"classes": {"a": 1, "b": [2, 1]}}, "1 twice"),
        ({"classes": {"a": {"ids": 1, "color": "red"}}}, "color"),
        ({"classes": {"a": -1, "b": 2}}, "from 0 to 65535 as ids, found -1"),
        ({"ignored": [70000]}, "70000"),
        ({"scans": "../*.npy"}, "below"),
        ({"scans": "*/*.pcd"}, "found none"),
        ({"scans": ""}, "the key scans"),
        ({"scans": "."}, "expected a pattern, found '.'"),
        ({"scans": "a\0b"}, "found none"),
        ({"scans": f"*/{'x' * 6000}.npy"}, "too long"),
        ({"labels": f"../{'x' * 6000}/{{name}}.label"}, "File name too long"),
        ({"root": "~nobody-has-this-name/x"}, "found none"),
        ({"labels": {"colour": 1}}, "colour"),
        ({"labels": "truth.npy"}, "{name}"),
        ({"labels": "../truth/labels.npy"}, "expected the scan's name in the file"),
        ({"labels": "../truth/{nme}.npy"}, "expected {name} for the scan's name, found {nme}"),
        ({"labels": "../{sequence}/{name}.npy"}, "found {sequence}"),
        ({"classes": {" ": 1, "b": 2}}, "expected names with letters, found ' '"),
        ({"split": {"training": "a"}}, "training"),
        ({"clases": {}, "extra": 1}, "extra"),
        ({"clases": {"a": 1}}, "found 'clases'; did you mean classes?"),
        ({"clases": {"a": 1}}, "own.yaml: expected keys of"),
        ({"columns": ["x", "y"]}, "own.yaml: columns: expected x, y and z"),
        ({"columns": ["x", "y", "z"], "dtype": "float33"}, "own.yaml: dtype: expected float32"),
        ({"dtype": "float64"}, "own.yaml: dtype: expected columns, and one type"),
        ({"split": {"vall": "a"}}, "found 'vall'; did you mean val?"),
    ],
)
def test_mistakes_in_the_file_are_one_line(site: Path, changes: dict[str, Any], word: str) -> None:
    path = describe(site.parent, **changes)
    fails(lambda: open_own(path), path.name if word != "found none" else word, word)


@pytest.mark.parametrize("columns", [3, 4.5])
def test_mistakes_in_rows_are_answered_by_keys_of_the_file(site: Path, columns: float) -> None:
    rows = np.random.default_rng(1).normal(0, 9, (8000, 4)).astype(np.float32)
    (site / "a.bin").write_bytes(rows.tobytes()[: int(4 * columns) * 7001])
    data = open_own(describe(site.parent, scans="*/*.bin"))
    (record,) = data.records(["site"])
    fails(lambda: data.read(record, labels=False), "columns: [x, y, z", "YAML")
    with pytest.raises(InputError, match=r"\A(?!.*--)"):  # no options, such as --columns
        data.read(record, labels=False)


@pytest.mark.parametrize("encoding", ["utf-16", "latin-1"])
def test_a_file_of_another_encoding_is_told_to_be_utf_8(site: Path, encoding: str) -> None:
    path = describe(site.parent)
    text = f"# schön\r\n{path.read_text()}"
    path.write_bytes(text.encode(encoding))
    fails(lambda: open_own(path), path, "save it as UTF-8")
    path.write_bytes(text.encode("utf-8-sig"))
    assert open_own(path).sequences("all") == ("site",)


@pytest.mark.parametrize(
    ("text", "mistake"),
    [
        ("classes: {a: 1, b: 2\nscans: '*.npy'\n", "a mistake in lines 1 to 2 (expected ','"),
        ("classes: {a: 1}\n\tscans: x\n", "a mistake in line 2 (found character '\\t'"),
        ("scans: a\nlabels: \x01\n", "a mistake in line 2 (the character '\\x01')"),
        ("scans: a\nclasses: [1, 2\n", "(expected ',' or ']', but got the end)"),
    ],
)
def test_a_broken_yaml_file_is_one_short_line_with_the_place_of_the_mistake(
    tmp_path: Path, text: str, mistake: str
) -> None:
    path = new_file(tmp_path / "own.yaml", text)
    with pytest.raises(InputError) as caught:
        open_own(path)
    line = str(caught.value).removeprefix(str(path))
    assert mistake in line
    assert len(line) < 200
    assert "<" not in line  # no source, such as <unicode string>


def test_a_message_names_a_label_file_without_dots(tmp_path: Path) -> None:
    (tmp_path / "data/points").mkdir(parents=True)
    (tmp_path / "data/labels").mkdir()
    (tmp_path / "sets").mkdir()
    np.save(tmp_path / "data/points/a.npy", some_points())
    path = tmp_path / "data/labels/a.label"
    RAW[:-1].astype(np.uint32).tofile(path)
    changes = {"root": "../data", "scans": "points/*.npy", "labels": "../labels/{name}.label"}
    fails(lambda: only_scan(tmp_path / "sets", **changes), f"{path}: expected 60 labels")


def test_dots_after_a_link_lead_to_the_folder_above_its_target(tmp_path: Path) -> None:
    (tmp_path / "disk/points").mkdir(parents=True)
    (tmp_path / "disk/labels").mkdir()
    np.save(tmp_path / "disk/points/a.npy", some_points())
    RAW.astype(np.uint32).tofile(tmp_path / "disk/labels/a.label")
    (tmp_path / "site").symlink_to(tmp_path / "disk/points")
    np.testing.assert_array_equal(only_scan(tmp_path, labels="../labels/{name}.label"), EXPECTED)


def test_a_column_of_labels_is_named_by_its_number(site: Path) -> None:
    """Labels of Waymo are instances and classes."""
    np.save(site / "a.waymo.npy", np.column_stack([np.arange(60), RAW]))
    labels = only_scan(site.parent, labels={"file": ".waymo.npy", "field": 1})
    np.testing.assert_array_equal(labels, EXPECTED)


def test_nan_is_no_label(site: Path) -> None:
    """CloudCompare writes it for points without a value."""
    labels = RAW.astype(np.float32)
    labels[::5] = np.nan
    np.save(site / "a.labels.npy", labels)
    expected = np.where(np.arange(60) % 5, EXPECTED, 0)
    np.testing.assert_array_equal(only_scan(site.parent, labels=".labels.npy"), expected)


def test_labels_that_are_true_or_false_are_1_and_0(site: Path) -> None:
    is_car = np.arange(60) % 2 == 0
    np.save(site / "a.labels.npy", is_car)
    changes = {"labels": ".labels.npy", "classes": {"other": 0, "car": 1}, "ignored": [9]}
    np.testing.assert_array_equal(only_scan(site.parent, **changes), 2 - is_car)
    np.save(site / "a.npy", some_points() > 0)  # no points
    fails(lambda: only_scan(site.parent, **changes), "bool")


def test_labels_that_do_not_fit_are_refused(site: Path) -> None:
    path = site / "a.label"

    RAW[:-1].astype(np.uint32).tofile(path)
    fails(lambda: only_scan(site.parent), path, "60 labels")
    np.full(60, 5, np.uint32).tofile(path)
    fails(lambda: only_scan(site.parent), path, "found 5")
    np.save(site / "a.half.npy", np.full(60, 0.5))
    fails(lambda: read_scan_labels(site / "a.half.npy", 60, SEMANTICKITTI), "whole numbers")
    for values, *words in (
        (np.full(60, 2.0**40), "32 bits"),
        (np.full(60, -(2.0**40)), "32 bits"),
        (np.where(np.arange(60) < 7, 0.5, 1), "whole numbers", "found 0.5 (7 of 60"),
        (np.where(np.arange(60) < 7, np.inf, 1), "whole numbers", "found inf (7 of 60"),
        (np.stack([RAW, RAW], axis=1), "2 columns", "field: 1"),
        (RAW.astype(str), "numbers"),
    ):
        np.save(site / "a.odd.npy", values)
        fails(lambda: read_scan_labels(site / "a.odd.npy", 60, SEMANTICKITTI), *words)
    fails(lambda: read_scan_labels(site / "none.npy", 60, SEMANTICKITTI), "no file")
    np.save(site / "evil.npy", np.array([{}], object), allow_pickle=True)
    fails(lambda: read_scan_labels(site / "evil.npy", 1, SEMANTICKITTI), "evil.npy")
