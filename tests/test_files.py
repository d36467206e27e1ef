"""Output files: whole, on the disk, with the umask's mode, and never outside the output folder."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import stat
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import IO, Any

import numpy as np
import pytest
import yaml
from hypothesis import strategies as st

from amvnet import files
from amvnet.cli.commands import demo
from amvnet.data.class_maps import class_map
from amvnet.data.datasets.files import ScanFiles
from amvnet.data.datasets.open import open_dataset
from amvnet.data.formats.cloud import Cloud
from amvnet.data.recordings import Recording, ScanFile
from amvnet.data.taxonomy import NUSCENES, Taxonomy
from amvnet.errors import InputError
from amvnet.files import alone_in, atomic_write, remove_unfinished
from amvnet.inference.pipeline import LabelFiles, OutputOptions, Pipeline, check_output
from amvnet.inference.segmentation import Segmentation
from amvnet.scan import Scan
from amvnet.weights.file import save
from lidarstreets.layouts import write_whole

from fixtures.commands import fails, new_file, refused, run_cli
from fixtures.datasets import MAKERS, make_nuscenes
from fixtures.examples import first_of, with_examples
from fixtures.surroundings import LINKS, NAMES, PRECIOUS, REFUSED, contents_outside, surroundings
from fixtures.tiny import fresh_weights, make_simulation_quick, street, without, write_recipe

COUNT = 7  # points of a scan


def label(inputs: Sequence[ScanFile], scans: Sequence[Scan]) -> list[Segmentation]:
    """Return labels without a network."""
    results = []
    for scan in scans:
        scores = np.full((len(scan), 16), 1 / 16, np.float32)
        ids = np.ones(len(scan), np.uint8)
        results.append(Segmentation(ids, ids == 0, scores, rv=scores, bev=scores))
    return results


def write(
    base: Path, scans: Sequence[ScanFile], kind: str = "label", written: Taxonomy | None = None
) -> None:
    output = OutputOptions(base / "out", LabelFiles(kind, True, True), written, overwrite=True)
    check_output(scans, output)
    Pipeline(scans, label, output).run({})


def some_cloud() -> Cloud:
    return Cloud(np.arange(3.0 * COUNT).reshape(COUNT, 3), np.zeros(COUNT))


def named(name: str, path: Path = Path("scan.bin")) -> ScanFile:
    scan = ScanFile(name, Recording("source"), path, prediction=f"{name}.label", read=some_cloud)
    return ScanFiles([scan], NUSCENES).records()[0]


def set_token(root: Path, token: str) -> None:
    path = root / "v1.0-mini/sample_data.json"
    rows = json.loads(path.read_text())
    for row in rows:
        if row["token"] == "scene-0103-9":
            row["token"] = token
    path.write_text(json.dumps(rows))


def with_token(token: str) -> Callable[[Path], None]:
    """Return what makes a small nuScenes of which one scan has a token."""

    def make(root: Path) -> None:
        make_nuscenes(root)
        set_token(root, token.replace("BASE", str(root.parent)))

    return make


# ---- nothing outside the output folder


@with_examples(150, name=NAMES, kind=st.sampled_from(["label", "npy", "ply"]), link=LINKS)
def test_names_of_scans_write_nothing_elsewhere(name: str, kind: str, link: str) -> None:
    with surroundings(link) as base:
        name = name.replace("BASE", str(base))
        scan = named(name)
        with suppress(InputError):
            write(base, [scan], kind)
        with suppress(InputError):  # the names are checked once more when a file is written
            loaded = scan.load()
            ids = np.ones(len(loaded), np.uint8)
            scan.dataset.write_labels(scan, base / "out", loaded, ids, kind=kind)


@with_examples(100, token=NAMES, link=LINKS, is_mapped=st.booleans())
def test_tokens_write_nothing_elsewhere(token: str, link: str, is_mapped: bool) -> None:
    with surroundings(link, make=with_token(token)) as base, suppress(InputError):
        dataset = open_dataset(f"nuscenes:{base}/data")
        written = class_map("coarse").target if is_mapped else None
        write(base, dataset.records(dataset.sequences("all")), written=written)


@with_examples(100, name=NAMES, link=LINKS, layout=st.sampled_from(list(MAKERS)))
def test_records_write_nothing_elsewhere(name: str, link: str, layout: str) -> None:
    with surroundings(link, make=MAKERS[layout]) as base:
        dataset = open_dataset(f"{layout}:{base}/data")
        first = dataset.records(dataset.sequences("all"))[0]
        record = replace(first, prediction=name.replace("BASE", str(base)))
        scan = dataset.read(record)
        ids = np.ones(len(scan), np.uint8)
        with suppress(InputError):
            dataset.write_labels(record, base / "out", scan, ids)


ENDINGS = st.sampled_from(["label", "npy", "ply", "npz", "uncertain.npy"])
FILES = st.builds("{}.{}".format, st.sampled_from(["a", "b", "c/a"]), ENDINGS)


@with_examples(
    60,
    kind=st.sampled_from(["label", "npy", "ply"]),
    inputs=st.lists(FILES, min_size=1, max_size=3, unique=True),
    links=st.dictionaries(FILES, FILES, max_size=3),
    overwrite=st.booleans(),
)
def test_scans_among_the_outputs_are_not_changed(
    kind: str, inputs: list[str], links: dict[str, str], overwrite: bool
) -> None:
    """The scans lie in the output folder, or links to them do. Empty files may be of any kind."""
    with surroundings() as base:
        out = base / "out"
        paths = [out / name for name in inputs]
        for path in paths:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
        for link, target in links.items():
            if target in inputs and link not in inputs:
                (out / link).parent.mkdir(parents=True, exist_ok=True)
                (out / link).symlink_to(out / target)
        before = {path: (path.lstat().st_ino, path.read_bytes()) for path in paths}

        scans: list[ScanFile] = []
        for name in ("a", "b", "c/a"):
            scans.append(named(name, paths[len(scans) % len(paths)]))
        output = OutputOptions(out, LabelFiles(kind, True, True), overwrite=overwrite)
        with suppress(InputError):
            check_output(scans, output)
            Pipeline(scans, label, output).run({})
        assert {path: (path.lstat().st_ino, path.read_bytes()) for path in paths} == before


@pytest.mark.parametrize("name", REFUSED)
def test_a_hostile_name_is_refused_before_anything_is_written(name: str) -> None:
    with surroundings("linked", "a/linked") as base:
        before = sorted((base / "out").rglob("*"))
        scans = [named("good"), named(name.replace("BASE", str(base)))]
        fails(partial(write, base, scans), base / "out")
        assert sorted((base / "out").rglob("*")) == before


def test_a_file_that_is_a_link_is_replaced_and_not_followed() -> None:
    """Here, the victims are labels and scores."""
    with surroundings() as base:
        write(base, [named("earlier")])
        for ending in ("label", "npz"):
            (base / f"out/earlier.{ending}").rename(base / f"victim/precious.{ending}")
            (base / f"out/good.{ending}").symlink_to(base / f"victim/precious.{ending}")
        before = contents_outside(base)
        write(base, [named("good")])
        assert contents_outside(base) == before
        assert not (base / "out/good.label").is_symlink()
        assert np.fromfile(base / "out/good.label", np.uint32).shape == (COUNT,)
        for ending in ("label", "npz"):  # as surroundings found them
            (base / f"victim/precious.{ending}").write_bytes(PRECIOUS)


@pytest.mark.parametrize("target", ["victim", "victim/precious", "victim/precious.label"])
def test_a_link_to_something_else_than_labels_is_not_replaced(target: str) -> None:
    with surroundings() as base:
        (base / "out").mkdir()
        (base / "out/good.label").symlink_to(base / target)
        fails(partial(write, base, [named("good")]), base / "out/good.label", "; ")
        assert (base / "out/good.label").is_symlink()


def test_an_output_folder_may_be_a_link() -> None:
    with surroundings() as base:
        (base / "out/real").mkdir(parents=True)
        (base / "out/link").symlink_to(base / "out/real")
        Pipeline([named("a/b")], label, OutputOptions(base / "out/link")).run({})
        assert (base / "out/real/a/b.label").is_file()


COMMANDS = (
    "predict nuscenes:{base}/data --weights {weights} --out {base}/out --scores",
    "fuse nuscenes:{base}/data --scores-a {base} --scores-b {base} --out {base}/out",
    "submit nuscenes:{base}/data --predictions {base} --split val --out {base}/out/a.zip",
    "evaluate nuscenes:{base}/data --predictions {base}/victim --pictures {base}/out",
    "rank nuscenes:{base}/data --weights {weights} --out {base}/out/r.csv",
    "view nuscenes:{base}/data --weights {weights} --html {base}/out/page.html",
    "train nuscenes-compact --data nuscenes:{base}/data --out {base}/out",
)


def each_of(commands: Sequence[str], *slow: str) -> list[Any]:
    """Return commands as parameters of tests; the slow ones are marked full."""
    parameters = []
    for command in commands:
        name = command.split()[0]
        marks = [pytest.mark.full] if name in slow else []
        parameters.append(pytest.param(command, marks=marks, id=name))
    return parameters


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save(fresh_weights(NUSCENES), tmp_path_factory.mktemp("weights") / "w.safetensors")


@pytest.mark.parametrize("command", each_of(COMMANDS, "train"))
def test_every_command_refuses_a_token_that_is_a_path(command: str, weights: Path) -> None:
    with surroundings(make=with_token("../../../victim/precious")) as base:
        refused(command.format(base=base, weights=weights), "'../../../victim/precious'")


HOSTILE = "../../../victim/precious"
# Commands that write files with names of their own, whatever the data say.
WRITERS = (
    "view {base}/data/own.yaml --weights {base}/data/w.safetensors --html {base}/out/page.html",
    "export --weights {base}/data/bev.safetensors --out {base}/out",
    "train {base}/data/r.yaml --data {base}/data/own.yaml --stage rv --out {base}/out",
    "rank {base}/data/own.yaml --weights {base}/data/w.safetensors --out {base}/out/r.csv",
    "evaluate {base}/data/own.yaml --weights {base}/data/w.safetensors --pictures {base}/out",
    "predict {base}/data/own.yaml --weights {base}/data/w.safetensors --out {base}/out --scores",
    "fuse {base}/data/own.yaml --scores-a {base}/data/scores --scores-b {base}/data/scores"
    " --out {base}/out",
    "submit nuscenes:{base}/data/nuscenes --predictions {base}/data/predictions --split val"
    " --out {base}/out/e.zip",
    "simulate {base}/out --scans 1",
    "demo --weights {base}/data/kitti.safetensors --out {base}/out",
)
SLOW_WRITERS = ("export", "train", "evaluate", "rank", "demo")


def make_hostile(folder: Path) -> None:
    """Make scans, weights and a recipe whose names of classes, sensors and sites are paths."""
    classes = {HOSTILE: 1, "/etc/passwd": 2, "</script><b>": 3, "__proto__": 4, "{base}%s\\": 5}
    for site in ("train", "val", "..a"):
        (folder / site).mkdir(parents=True)
        points, raw = street(0, 400)
        np.save(folder / site / "%2e%2e%2fx.npy", points)
        np.save(folder / site / "%2e%2e%2fx_labels.npy", raw % 5 + 1)
        (folder / "scores" / site).mkdir(parents=True)
        np.save(folder / "scores" / site / "%2e%2e%2fx.npy", np.full((400, 5), 0.2))
    description = {
        "name": HOSTILE,
        "classes": classes,
        "scans": "*/*x.npy",
        "labels": "{name}_labels.npy",
        "split": {"train": "train", "val": ["val", "..a"]},
    }
    (folder / "own.yaml").write_text(yaml.safe_dump(description))
    write_recipe(folder / "r.yaml", training={"rv": {"epochs": 1}})
    taxonomy = open_dataset(str(folder / "own.yaml")).taxonomy
    weights = replace(fresh_weights(taxonomy), sensor=HOSTILE)
    save(weights, folder / "w.safetensors")
    save(without(weights, "range_net", "point_head"), folder / "bev.safetensors")
    save(replace(fresh_weights(), sensor=HOSTILE), folder / "kitti.safetensors")

    make_nuscenes(folder / "nuscenes")
    set_token(folder / "nuscenes", "%2e%2e%2f..x $(id) </script>".replace("/", ""))
    nuscenes = open_dataset(f"nuscenes:{folder / 'nuscenes'}")
    for record in nuscenes.records(nuscenes.sequences("all")):
        scan = nuscenes.read(record)
        nuscenes.write_labels(record, folder / "predictions", scan, np.ones(len(scan), np.uint8))
    (folder / "temporary").mkdir()


@pytest.mark.parametrize("command", each_of(WRITERS, *SLOW_WRITERS))
def test_names_in_the_data_do_not_lead_a_command_elsewhere(
    command: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Nor does it change what it reads, or leave files anywhere but in its output folder."""
    if command.startswith("export"):
        pytest.importorskip("onnxscript")
    if command.startswith(("simulate", "demo")):
        pytest.importorskip("embreex")
        monkeypatch.setattr(demo, "SEQUENCES", 1)
        monkeypatch.setattr(demo, "SCANS", 1)
        make_simulation_quick(monkeypatch)
    with surroundings(make=make_hostile) as base:
        monkeypatch.setattr(tempfile, "tempdir", str(base / "data/temporary"))
        monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))  # torch keeps its cache
        code, error = run_cli(*command.format(base=base).split())
        assert code in (0, 2), error
        assert code == 0 or "Traceback" not in error
        succeeded = [path for path in (base / "out").rglob("*") if path.is_file()]
        assert (code == 0) == bool(succeeded), error


@pytest.mark.parametrize("command", each_of(COMMANDS[:2]))
def test_a_linked_folder_of_the_output_is_refused(command: str, weights: Path) -> None:
    with surroundings("lidarseg", make=with_token("precious")) as base:
        for token in ("precious", "scene-0103-8", "scene-0061-9", "scene-0061-8"):
            scores = base / f"out/scores/lidarseg/mini_val/{token}_lidarseg.npy"
            scores.parent.mkdir(parents=True, exist_ok=True)
            np.save(scores, np.ones((COUNT, 16)))
        line = command.replace("{base} ", "{base}/out/scores ")
        refused(f"{line.format(base=base, weights=weights)} --split mini_val", "found a link")


@pytest.mark.parametrize("link", ["sequences", "sequences/00", "sequences/00/velodyne"])
def test_simulated_scans_are_not_written_through_a_link(link: str) -> None:
    with surroundings(link) as base:
        refused(f"simulate {base}/out --scans 1", "found a link")


# ---- one file


def write_file(path: Path, content: bytes) -> None:
    with atomic_write(path) as part:
        part.write_bytes(content)


@pytest.fixture(params=first_of([0o077, 0o022, 0o002]))
def umask(request: pytest.FixtureRequest) -> Iterator[int]:
    earlier = os.umask(request.param)
    yield request.param
    os.umask(earlier)


def test_every_file_has_the_mode_of_the_umask(umask: int, tmp_path: Path) -> None:
    save(fresh_weights(), tmp_path / "w.safetensors")  # safetensors writes private files
    street(0)[0].tofile(tmp_path / "a.bin")
    code, error = run_cli("predict", tmp_path / "a.bin", "--weights", tmp_path / "w.safetensors",
                          "--out", tmp_path / "out", "--scores", "--uncertain")  # fmt: skip
    assert (code, error) == (0, "")

    paths = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert len(paths) == 6
    assert {stat.S_IMODE(path.stat().st_mode) for path in paths} == {0o666 & ~umask}


def test_content_is_on_disk_before_a_name(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    calls: list[tuple[str, Any]] = []

    def record(name: str) -> Callable[..., None]:
        real = getattr(os, name)

        def call(first: Any, *others: Any) -> None:
            inode = os.fstat(first).st_ino if name == "fsync" else Path(first).stat().st_ino
            calls.append((name, inode))
            real(first, *others)

        return call

    for name in ("fsync", "replace"):
        monkeypatch.setattr(os, name, record(name))
    with atomic_write(tmp_path / "a.txt") as part:
        part.write_text("a")

    inode = (tmp_path / "a.txt").stat().st_ino
    assert calls == [("fsync", inode), ("replace", inode), ("fsync", tmp_path.stat().st_ino)]


def test_a_block_that_fails_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = new_file(tmp_path / "a.txt", PRECIOUS)
    with suppress(KeyboardInterrupt), atomic_write(path) as part:
        part.write_text("half")
        raise KeyboardInterrupt
    assert path.read_bytes() == PRECIOUS
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("name", ["a" * 255, "a." + "b" * 253])
def test_the_longest_names_can_be_written(name: str, tmp_path: Path) -> None:
    with atomic_write(tmp_path / name) as part:
        part.write_bytes(b"")
    assert (tmp_path / name).is_file()


def test_a_name_that_is_too_long_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="too long"), atomic_write(tmp_path / ("a" * 256)):
        pass
    assert not list(tmp_path.iterdir())


def test_an_error_of_the_disk_names_the_file_and_not_its_temporary_name(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def fail(part: Path, path: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(part))

    monkeypatch.setattr(files, "publish", fail)
    with pytest.raises(OSError, match="No space") as caught, atomic_write(tmp_path / "a"):
        pass
    assert caught.value.filename == str(tmp_path / "a")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("write", [write_file, write_whole])
def test_a_read_only_folder_is_one_line_that_names_the_file(
    write: Callable[[Path, bytes], object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path, *arguments: object, **options: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system", str(path))

    for name in ("touch", "write_bytes", "unlink"):
        monkeypatch.setattr(Path, name, refuse)
    with pytest.raises(ValueError, match="Read-only file system; give another") as caught:
        write(tmp_path / "a.txt", b"")
    assert str(caught.value).startswith(f"{tmp_path}/a.txt: expected")


def test_an_output_folder_that_is_a_file_is_called_one(tmp_path: Path) -> None:
    path = new_file(tmp_path / "out", PRECIOUS)
    fails(lambda: files.make_folder(path), "expected a folder to write to, found a file; give")
    assert path.read_bytes() == PRECIOUS


def test_what_killed_runs_left_is_removed_in_all_folders_but_nothing_else(tmp_path: Path) -> None:
    unfinished = f".{'0123456789abcdef' * 2}.part"
    (tmp_path / unfinished).mkdir()
    (tmp_path / unfinished / "weights.bin").write_bytes(b"")
    kept = []
    for folder in (tmp_path, tmp_path / "rv", tmp_path / "sequences/00/predictions"):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{unfinished}.label").write_bytes(b"")
        kept += [folder / "0.label", folder / ".0123.part"]
    for path in kept:
        path.write_bytes(PRECIOUS)

    remove_unfinished(tmp_path)
    assert {path for path in tmp_path.rglob("*") if path.is_file()} == set(kept)
    assert not (tmp_path / unfinished).exists()


def test_a_lock_that_another_run_removed_after_it_was_opened_keeps_nobody_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run that ends removes its file, which this one may have opened just before."""
    lock = fcntl.flock

    def remove_first(file: IO[str], how: int) -> None:
        monkeypatch.setattr(fcntl, "flock", lock)
        (tmp_path / ".lock").unlink()
        lock(file, how)

    monkeypatch.setattr(fcntl, "flock", remove_first)
    with alone_in(tmp_path):
        assert (tmp_path / ".lock").is_file()
        fails(alone_in(tmp_path).__enter__, tmp_path, "another run")
