"""Lone scan files in every format agree; label tables are checked by plain loops; wrong input is named."""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import numpy as np
import pytest
import yaml

from amvnet.data.scan_files import find_scans, read_scan, write_labels
from amvnet.data.taxonomy import NUSCENES, SEMANTICKITTI, TAXONOMIES, Taxonomy, taxonomy_from_yaml
from amvnet.files import atomic_write

from fixtures.worlds import fails, label_map

# --- lone files ---


@pytest.mark.parametrize("scale", [1.0, 255.0])
def test_lone_scans_in_every_format_agree(tmp_path: Path, scale: float) -> None:
    points = np.random.default_rng(0).random((9, 4)).astype(np.float32)
    points[0, 3] = 1.0
    raw = points * np.array([1, 1, 1, scale], dtype=np.float32)
    ring = np.arange(9, dtype=np.float32)[:, None]
    raw.tofile(tmp_path / "a.bin")
    np.save(tmp_path / "b.npy", raw.astype(np.float64))
    np.save(tmp_path / "c.npy", np.hstack([raw, ring]))
    np.hstack([points * np.array([1, 1, 1, 255], dtype=np.float32), ring]).tofile(
        tmp_path / "d.pcd.bin"
    )
    found = find_scans(tmp_path)
    assert [path.name for path in found] == ["a.bin", "b.npy", "c.npy", "d.pcd.bin"]
    for path in found:
        scan = read_scan(path)
        np.testing.assert_allclose(scan.points, points, rtol=1e-6)
        assert (scan.ring is not None) == (path.name[0] in "cd")
        assert scan.name == str(path)


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


def test_unusable_files_are_named(tmp_path: Path) -> None:
    for name, content in {
        "a.bin": b"",
        "b.bin": bytes(17),
        "c.pcd.bin": bytes(16),
        "d.npy": b"not numpy",
        "f.npy": b"",
        "e.xyz": b"1 2 3",
    }.items():
        (tmp_path / name).write_bytes(content)
        fails(lambda path=tmp_path / name: read_scan(path), tmp_path / name)  # type: ignore[misc]
    fails(lambda: read_scan(tmp_path / "e.xyz"), ".pcd.bin", ".bin", ".npy")
    fails(lambda: read_scan(tmp_path / "no.bin"), tmp_path / "no.bin")
    fails(lambda: find_scans(tmp_path / "no"), tmp_path / "no")
    (tmp_path / "empty").mkdir()
    fails(lambda: find_scans(tmp_path / "empty"), tmp_path / "empty")
    assert find_scans(tmp_path / "a.bin") == [tmp_path / "a.bin"]


def test_files_appear_whole_or_not_at_all(tmp_path: Path) -> None:
    target = tmp_path / "deep" / "a.label"

    def stop_halfway() -> None:
        with atomic_write(target) as part:
            part.write_bytes(b"half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        stop_halfway()
    assert list(target.parent.iterdir()) == []
    write_labels(target, np.array([10, 259], dtype=np.uint32))
    assert np.fromfile(target, np.uint32).tolist() == [10, 259]
    fails(lambda: write_labels(target / "b.label", np.zeros(1)), target, "folder")
    fails(lambda: write_labels(tmp_path, np.zeros(1)), tmp_path)


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


def test_lookup_equals_a_plain_loop() -> None:
    raw = np.random.default_rng(0).choice(list(SEMANTICKITTI.raw_to_train), 200).astype(np.uint32)
    assert SEMANTICKITTI.to_train(raw).tolist() == [SEMANTICKITTI.raw_to_train[int(r)] for r in raw]
    assert SEMANTICKITTI.to_train(raw[:0]).shape == (0,)


@pytest.mark.parametrize("taxonomy", TAXONOMIES.values(), ids=TAXONOMIES)
def test_taxonomy_survives_json_and_pickle(taxonomy: Taxonomy) -> None:
    assert Taxonomy.from_dict(json.loads(json.dumps(taxonomy.to_dict()))) == taxonomy
    assert pickle.loads(pickle.dumps(taxonomy)) == taxonomy
    fails(lambda: Taxonomy.from_dict({"name": "a"}), "classes")


def test_sizes_of_the_benchmarks() -> None:
    assert (SEMANTICKITTI.size, NUSCENES.size) == (19, 16)
    assert (len(SEMANTICKITTI.raw_to_train), len(NUSCENES.raw_to_train)) == (34, 32)
    assert SEMANTICKITTI.splits["val"] == ("08",)


def test_yaml_label_map_is_the_built_in_one(tmp_path: Path) -> None:
    path = tmp_path / "semantic-kitti.yaml"
    path.write_text(yaml.safe_dump(label_map()))
    assert taxonomy_from_yaml(path) == SEMANTICKITTI


def test_incomplete_label_maps_are_named(tmp_path: Path) -> None:
    path = tmp_path / "labels.yaml"
    fails(lambda: taxonomy_from_yaml(path), path)
    for key in label_map():
        path.write_text(yaml.safe_dump({k: v for k, v in label_map().items() if k != key}))
        fails(lambda: taxonomy_from_yaml(path), path, key)
    wrong = [
        {**label_map(), "labels": {0: "unlabeled"}},
        {**label_map(), "learning_map": {70_000: 1}},
    ]
    for content in ("a: [", "[1]", *map(yaml.safe_dump, wrong)):
        path.write_text(content)
        fails(lambda: taxonomy_from_yaml(path), path)
