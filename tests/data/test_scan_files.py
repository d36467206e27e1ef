"""Scan files of every format agree, label tables equal plain loops, and errors name the input."""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import numpy as np
import pytest

from amvnet import read as read_scan
from amvnet.config.yaml_files import read_yaml
from amvnet.data.formats.find import find_scans
from amvnet.data.taxonomy import TAXONOMIES, Taxonomy

from fixtures.commands import fails, new_file

# --- single files ---


def test_three_columns_get_no_intensity(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.ones((4, 3)))
    assert read_scan(tmp_path / "a.npy").points.tolist() == [[1, 1, 1, 0]] * 4


@pytest.mark.parametrize(
    "array",
    [
        np.zeros((0, 4)),
        np.full((3, 4), np.nan),
        np.zeros((3, 2)),
        np.zeros((3, 6)),
        np.zeros(4),
        np.zeros((2, 4), dtype=complex),
        np.zeros(3, dtype=[("x", float), ("y", float), ("z", float)]),
        np.array([{"x": 1}], dtype=object),
        np.array([[0, 0, 0, 0, 0.5]]),
    ],
)
def test_unusable_arrays_are_named(tmp_path: Path, array: np.ndarray) -> None:
    path = tmp_path / "a.npy"
    np.save(path, array, allow_pickle=True)
    fails(lambda: read_scan(path), path)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.bin", b""),
        ("b.bin", bytes(17)),
        ("c.pcd.bin", bytes(16)),
        ("d.npy", b"not numpy"),
        ("e.xyz", b"1 2"),
        ("f.npy", b""),
    ],
)
def test_unusable_files_are_named(tmp_path: Path, name: str, content: bytes) -> None:
    path = new_file(tmp_path / name, content)
    fails(lambda: read_scan(path), path)
    assert find_scans(path) == [path]


def test_an_unknown_format_is_refused_with_the_known_ones(tmp_path: Path) -> None:
    path = new_file(tmp_path / "a.scan", b"1 2")
    fails(lambda: read_scan(path), ".pcd.bin", ".bin", ".npy")


def test_missing_files_and_empty_folders_are_named(tmp_path: Path) -> None:
    fails(lambda: read_scan(tmp_path / "no.bin"), tmp_path / "no.bin")
    fails(lambda: find_scans(tmp_path / "no"), tmp_path / "no")
    (tmp_path / "empty").mkdir()
    fails(lambda: find_scans(tmp_path / "empty"), tmp_path / "empty")


# --- taxonomies ---


@pytest.mark.parametrize("taxonomy", TAXONOMIES.values(), ids=TAXONOMIES)
def test_raw_and_train_ids_are_inverse(taxonomy: Taxonomy) -> None:
    ids = np.arange(taxonomy.size + 1)
    raw = taxonomy.to_raw(ids)
    assert raw.dtype == np.uint32
    assert taxonomy.to_train(raw).tolist() == ids.tolist()
    assert taxonomy.to_train(raw | np.uint32(7 << 16)).tolist() == ids.tolist()
    assert len(taxonomy.colors) == taxonomy.size + 1

    fails(lambda: taxonomy.to_train(np.array([400], dtype=np.uint32)), "400", taxonomy.name)
    fails(lambda: taxonomy.to_raw(np.array([taxonomy.size + 1])), taxonomy.size + 1)


@pytest.mark.parametrize("taxonomy", TAXONOMIES.values(), ids=TAXONOMIES)
def test_taxonomy_survives_json_and_pickle(taxonomy: Taxonomy) -> None:
    assert Taxonomy.from_dict(json.loads(json.dumps(taxonomy.to_dict()))) == taxonomy
    assert pickle.loads(pickle.dumps(taxonomy)) == taxonomy
    fails(lambda: Taxonomy.from_dict({"name": "a"}), "classes")


@pytest.mark.parametrize("text", ["a: 1\nb: 2\na: 3\n", "b: {c: 1, 'c': 2}\n", "- {1: a, 1: b}\n"])
def test_a_key_twice_in_yaml_is_refused(text: str, tmp_path: Path) -> None:
    path = new_file(tmp_path / "a.yaml", text)
    fails(lambda: read_yaml(path, "values"), path, "twice")


def test_aliases_in_yaml_are_refused_and_anchors_are_not(tmp_path: Path) -> None:
    path = new_file(tmp_path / "a.yaml", "a: &a [1, 2]\n")
    assert read_yaml(path, "a list") == {"a": [1, 2]}
    for text in ("a: &a [1]\nb: *a\n", "a: &a {k: 1}\nb: {<<: *a}\n", "&a [*a]"):
        path.write_text(text)
        fails(lambda: read_yaml(path, "a list"), path, "*a", "write its value out")


def test_a_text_file_of_poses_is_no_scan(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "poses.txt", np.eye(12))
    fails(lambda: find_scans(tmp_path), tmp_path, "found none")
    np.savetxt(tmp_path / "scan.txt", np.ones((4, 4)))
    assert find_scans(tmp_path) == [tmp_path / "scan.txt"]
