"""The cache of exported networks: it is checked, and not used if other users can write it."""

from __future__ import annotations

import hashlib
import json
import os
import stat
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import amvnet
from amvnet.engines.export import cache
from amvnet.engines.export.cache import cached_networks, user_cache
from amvnet.engines.onnx import RANGE_NET, UNET
from amvnet.files import unfinished
from amvnet.onnx_runner import DESCRIPTION, FORMAT, GRAPHS_BY_METHOD
from amvnet.scan import Scan
from amvnet.weights.file import Weights

from fixtures.commands import files, not_none
from fixtures.tiny import fresh_weights, street

WEIGHTS = fresh_weights()


class Exports:
    """Stands in for `export`: writes small files with `contents` for every graph, and counts."""

    def __init__(self) -> None:
        self.count = 0
        self.content = b"graph"

    def __call__(self, weights: Weights, out: Path | str, scans: Sequence[Scan] = ()) -> None:
        self.count += 1
        graphs = {}
        for name in GRAPHS_BY_METHOD["amvnet"]:
            content = b" ".join((name.encode(), self.content))
            (Path(out) / f"{name}.onnx").write_bytes(content)
            graphs[name] = {
                "file": f"{name}.onnx",
                "sha256": hashlib.sha256(content).hexdigest(),
                "inputs": [{"name": "x"}],
            }
        description = {"format": FORMAT, "method": "amvnet", "classes": [], "graphs": graphs}
        (Path(out) / DESCRIPTION).write_text(json.dumps(description))


@pytest.fixture
def exports(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Exports:
    """Use a cache of this test, and count the exports into it."""
    stand_in = Exports()
    monkeypatch.setenv("AMVNET_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(cache, "check_libraries", lambda: None)
    monkeypatch.setattr(cache, "export", stand_in)
    monkeypatch.setattr(cache, "simulated_scans", lambda weights: [])
    return stand_in


def cached(weights: Weights = WEIGHTS, int8: bool = False) -> tuple[dict[str, bytes], str]:
    """Return the contents of the graphs, and what is said."""
    said: list[str] = []
    return dict(cached_networks(weights, int8, said.append).files), "\n".join(said)


def filled(weights: Weights = WEIGHTS) -> Path:
    return not_none(cached_networks(weights).folder)


def test_networks_are_exported_once_for_each_weights_and_precision(exports: Exports) -> None:
    first, said = cached()
    assert set(first) == {RANGE_NET, UNET}
    assert "exported, once" in said
    assert cached() == (first, "")
    assert exports.count == 1

    other = fresh_weights(seed=8)
    view = replace(WEIGHTS.model.range_view, width=128)  # the same parameters, another graph
    wider = replace(WEIGHTS, model=replace(WEIGHTS.model, range_view=view))
    folders = {filled(), filled(other), filled(wider)}
    assert exports.count == 3
    cached(int8=True)
    assert exports.count == 4
    assert len(folders) == 3
    assert {path.name for path in user_cache().glob("onnx/*")} > {each.name for each in folders}


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1])


def swap(path: Path) -> None:
    """Replace a graph by another one, which would give labels without an error."""
    path.write_bytes(path.with_name("polar_map.onnx").read_bytes())


def make_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


DAMAGES: list[tuple[str, Callable[[Path], object]]] = [
    ("range_net.onnx", truncate),
    ("range_net.onnx", swap),
    ("range_net.onnx", Path.unlink),
    ("range_net.onnx", make_folder),
    ("polar_map.onnx", lambda path: path.write_bytes(b"")),
    (DESCRIPTION, Path.unlink),
    (DESCRIPTION, truncate),
    (DESCRIPTION, lambda path: path.write_text("[" * 100_000)),
    (DESCRIPTION, lambda path: path.write_text(path.read_text().replace("range_net", "x"))),
    (DESCRIPTION, lambda path: path.write_text(path.read_text().replace('"amvnet"', '"rv"'))),
    (DESCRIPTION, lambda path: path.write_text(path.read_text().replace("sha256", "x"))),
]


@pytest.mark.parametrize(("name", "damage"), DAMAGES)
def test_what_is_changed_in_the_cache_is_exported_again(
    name: str, damage: Callable[[Path], object], exports: Exports
) -> None:
    folder = filled()
    before, _ = cached()
    damage(folder / name)
    networks, said = cached()
    assert networks == before
    assert "missing or changed" in said
    assert exports.count == 2

    assert cached() == (before, "")
    assert exports.count == 2
    assert files(user_cache()) == {
        f"onnx/{folder.name}/{each}"
        for each in (*(f"{n}.onnx" for n in GRAPHS_BY_METHOD["amvnet"]), DESCRIPTION)
    }


def test_a_file_or_a_link_in_the_place_of_a_folder_is_replaced(
    exports: Exports, tmp_path: Path
) -> None:
    folder = filled()
    folder.rename(tmp_path / "elsewhere")
    (tmp_path / "elsewhere/range_net.onnx").write_bytes(b"changed")
    folder.symlink_to(tmp_path / "elsewhere")
    cached()
    assert folder.is_dir()
    assert not folder.is_symlink()
    assert (tmp_path / "elsewhere/range_net.onnx").read_bytes() == b"changed"

    folder.rename(tmp_path / "again")
    folder.write_text("a file")
    cached()
    assert cached()[1] == ""
    assert exports.count == 3


@pytest.mark.parametrize("mode", [stat.S_IWOTH, stat.S_IWGRP])
@pytest.mark.parametrize("place", ["range_net.onnx", DESCRIPTION, ".", "..", "../..", "../../.."])
def test_a_cache_that_another_user_can_write_is_not_used_and_that_is_said(
    place: str, mode: int, exports: Exports, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cache, "_is_group_of_one", lambda gid: False)
    changed = (filled() / place).resolve()
    before = stat.S_IMODE(changed.stat().st_mode)
    changed.chmod(before | mode)
    exports.content = b"another graph"
    try:
        stored = {name: (user_cache() / name).read_bytes() for name in files(user_cache())}
        for count in (2, 3):
            networks, said = cached()
            assert str(changed) in said
            assert "no other user" in said
            assert "AMVNET_CACHE" in said
            assert networks[RANGE_NET] == b"range_net another graph"
            assert exports.count == count
            assert cached_networks(WEIGHTS).folder is None
            exports.count -= 1
        assert {n: (user_cache() / n).read_bytes() for n in stored} == stored
    finally:
        changed.chmod(before)
    assert cached()[1] == ""


def test_a_folder_in_which_only_owners_can_rename_may_hold_the_cache(
    exports: Exports, tmp_path: Path
) -> None:
    """As /tmp does."""
    tmp_path.chmod(0o1777)
    filled()
    assert cached()[1] == ""


def test_the_group_of_this_user_alone_may_write(
    exports: Exports, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Some systems make a group for each user, and let it write."""
    filled().chmod(0o770)
    import grp
    import pwd

    user = pwd.getpwuid(os.getuid())
    for name, members, is_used in (
        (user.pw_name, [], True),
        (user.pw_name, ["someone"], False),
        ("staff", [], False),
    ):
        group = SimpleNamespace(gr_name=name, gr_mem=members)
        monkeypatch.setattr(grp, "getgrgid", lambda gid, group=group: group)
        assert ("no other user" in cached()[1]) != is_used


def test_a_cache_of_another_user_is_not_used(
    exports: Exports, monkeypatch: pytest.MonkeyPatch
) -> None:
    filled()
    monkeypatch.setattr(os, "getuid", lambda: 12_345_678)
    monkeypatch.setattr(cache, "_is_own", lambda status: False)
    assert "no other user" in cached()[1]


def test_without_a_place_for_a_cache_the_networks_are_exported_for_one_run(
    exports: Exports, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in a container whose home is read-only. A signal leaves no folder."""
    (tmp_path / "file").touch()
    monkeypatch.setenv("AMVNET_CACHE", str(tmp_path / "file" / "cache"))
    folders: list[Path] = []

    def export(weights: Weights, out: Path, scans: Sequence[Scan]) -> None:
        assert out in unfinished
        folders.append(out)
        exports(weights, out)

    monkeypatch.setattr(cache, "export", export)
    for count in (1, 2):
        contents, said = cached()
        assert set(contents) == {RANGE_NET, UNET}
        assert "expected a cache to write to" in said
        assert exports.count == count
        assert not folders[-1].exists()


def test_new_folders_and_files_of_the_cache_are_private(exports: Exports) -> None:
    before = os.umask(0)
    try:
        folder = filled()
    finally:
        os.umask(before)
    for path in (user_cache(), folder.parent, folder):
        assert stat.S_IMODE(path.stat().st_mode) == 0o700
    for path in folder.iterdir():
        assert stat.S_IMODE(path.stat().st_mode) == 0o600


@pytest.mark.parametrize("is_damaged", [False, True])
def test_concurrent_exports_into_one_cache_all_succeed_and_leave_one_whole(
    is_damaged: bool, exports: Exports, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each export differs, as the bytes of an exporter may: a mixture would be seen."""
    if is_damaged:
        truncate(filled() / "range_net.onnx")
    workers = 8
    together = threading.Barrier(workers)

    def export(weights: Weights, out: Path, scans: Sequence[Scan]) -> None:
        own = Exports()
        own.content = str(threading.get_ident()).encode()
        own(weights, out)
        together.wait()

    monkeypatch.setattr(cache, "export", export)
    results: list[dict[str, bytes]] = []
    threads = [threading.Thread(target=lambda: results.append(cached()[0])) for _ in range(workers)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    assert len(results) == workers
    for networks in results:
        assert len({content.split()[1] for content in networks.values()}) == 1
    kept, said = cached()
    assert not said
    assert kept in results
    assert len(list((user_cache() / "onnx").iterdir())) == 1


def test_an_export_that_fails_leaves_nothing(
    exports: Exports, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(weights: Weights, out: Path, scans: Sequence[Scan]) -> None:
        (out / "range_net.onnx").write_bytes(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(cache, "export", fail)
    with pytest.raises(KeyboardInterrupt):
        cached()
    assert list((user_cache() / "onnx").iterdir()) == []


def test_the_cache_lies_where_it_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AMVNET_CACHE", str(tmp_path / "cache"))
    assert user_cache() == tmp_path / "cache"

    monkeypatch.delenv("AMVNET_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "caches"))
    assert user_cache() == tmp_path / "caches" / "amvnet"

    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert user_cache() == tmp_path / ".cache" / "amvnet"


def test_weights_of_one_network_have_one_graph(
    exports: Exports, monkeypatch: pytest.MonkeyPatch
) -> None:
    weights = replace(
        WEIGHTS, tensors={k: v for k, v in WEIGHTS.tensors.items() if k.startswith("range_net.")}
    )

    def export(weights: Weights, out: Path, scans: Sequence[Scan]) -> None:
        exports(weights, out)
        description: dict[str, Any] = json.loads((out / DESCRIPTION).read_text()) | {"method": "rv"}
        description["graphs"] = {RANGE_NET: description["graphs"][RANGE_NET]}
        (out / DESCRIPTION).write_text(json.dumps(description))

    monkeypatch.setattr(cache, "export", export)
    assert set(cached(weights)[0]) == {RANGE_NET}
    assert cached(weights)[1] == ""


@pytest.mark.full
def test_a_changed_graph_changes_no_label(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the real export: the graph of another network of the same shape."""
    pytest.importorskip("onnxruntime")
    monkeypatch.setenv("AMVNET_CACHE", str(tmp_path))
    points = street(0, 600)[0]
    expected = amvnet.load(WEIGHTS, engine="onnx")(points)
    amvnet.load(fresh_weights(seed=8), engine="onnx")
    first, second = sorted((tmp_path / "onnx").iterdir())
    (first / "range_net.onnx").write_bytes((second / "range_net.onnx").read_bytes())
    (second / "polar_map.onnx").write_bytes((first / "polar_map.onnx").read_bytes()[:1000])
    assert np.array_equal(amvnet.load(WEIGHTS, engine="onnx")(points).scores, expected.scores)
