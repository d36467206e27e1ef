"""No command replaces a file without --overwrite, and --resume goes on with what is there."""

from __future__ import annotations

import io
import json
import os
import shlex
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from amvnet.files import Signature, check_outputs
from amvnet.inference.journal import JOURNAL, UNFINISHED
from amvnet.onnx_runner import DESCRIPTION

from fixtures.commands import contents, fails, files, new_file, refusal, refused, run_cli, succeed
from fixtures.marks import with_full

MINE = b"hours of work"
ANYTHING = Signature("a file", b"")


def saved(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


PNG = b"\x89PNG\r\n\x1a\n...Software\0Matplotlib..."
PLY = (
    b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
    b"property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n"
    b"property int class\nend_header\n"
)


@dataclass(frozen=True)
class Case:
    """A command, a file that it writes into its output, and an earlier file of this kind."""

    command: str
    file: str
    earlier: bytes

    def text(self, world: Path, out: Path) -> str:
        return self.command.format(world=world, out=out)


WEIGHTS = "--weights {world}/w.safetensors"
SCORES = "--scores-a {world}/predictions --scores-b {world}/predictions"
SCANS = f"predict {{world}}/pair {WEIGHTS} --out {{out}}"
EVALUATE = "evaluate {world}/data --predictions {world}/predictions"
FIRST = "sequences/08/predictions/000000.label"
PAGE = b'<!doctype html>\n<meta name="generator" content="AMVNet">'
LABELS = bytes(8)
CASES = {
    "predict": Case(SCANS, "b.label", LABELS),
    "npy": Case(f"{SCANS} --format npy", "b.npy", saved(np.zeros(3, np.uint32))),
    "ply": Case(f"{SCANS} --format ply", "b.ply", PLY),
    "scores": Case(f"{SCANS} --scores", "a.npz", b"PK\3\4" + bytes(26) + b"rv.npy"),
    "uncertain": Case(f"{SCANS} --uncertain", "a.uncertain.npy", saved(np.zeros(3, bool))),
    "dataset": Case(f"predict {{world}}/data {WEIGHTS} --out {{out}}", FIRST, LABELS),
    "fuse": Case(f"fuse {{world}}/data {SCORES} --out {{out}}", FIRST, LABELS),
    "rank": Case(
        f"rank {{world}}/data {WEIGHTS} --out {{out}}/r.csv --split all",
        "r.csv",
        b"rank,scan,score,x,y,z,points,point,rv,bev,label\n",
    ),
    "submit": Case(
        "submit {world}/data --predictions {world}/predictions --split val --out {out}/e.zip",
        "e.zip",
        b"PK\3\4" + bytes(26) + b"sequences/PK",
    ),
    "view": Case(f"view {{world}}/data {WEIGHTS} --html {{out}}/page.html", "page.html", PAGE),
    "figures": Case(f"{EVALUATE} --json {{out}}/m.json", "m.json", b'{"dataset": "mine"}'),
    "pictures": Case(f"{EVALUATE} --pictures {{out}}", "08_000000.png", PNG),
    "bench": Case(
        f"bench {WEIGHTS} --runs 1 --scan {{world}}/pair/a.bin --json {{out}}/b.json",
        "b.json",
        b'{"engine": "torch"}',
    ),
    "analyze": Case(f"analyze {{world}}/data {WEIGHTS} --out {{out}}", "tau.png", PNG),
    "table": Case(f"analyze {{world}}/data {WEIGHTS} --out {{out}}", "tau.csv", b"tau,mIoU %\n"),
}
SLOW = ("pictures", "analyze", "table")  # they draw
ALIKE = ("npy", "ply", "scores", "uncertain", "dataset")  # they are like `predict`


@pytest.mark.parametrize("name", with_full(CASES, ALIKE))
def test_a_users_file_stays_and_nothing_is_written(
    name: str, world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    case = CASES[name]
    mine = new_file(tmp_path / case.file, MINE)

    refused(case.text(world, tmp_path), case.file, "--overwrite")

    # Nor is a file of another kind replaced.
    refused(case.text(world, tmp_path) + " --overwrite", case.file, "found another file")
    assert mine.read_bytes() == MINE
    assert files(tmp_path) == {case.file}
    assert "computing on" not in capsys.readouterr().out  # the networks are not loaded for that


@pytest.mark.parametrize("name", with_full(CASES, SLOW + ALIKE))
def test_files_of_one_kind_are_replaced_if_told(name: str, world: Path, tmp_path: Path) -> None:
    case = CASES[name]
    earlier = new_file(tmp_path / case.file, case.earlier)
    succeed(case.text(world, tmp_path) + " --overwrite")
    assert earlier.read_bytes() != case.earlier


@pytest.mark.parametrize("name", with_full(sorted(set(CASES) - {"bench", "table"}), SLOW + ALIKE))
def test_a_command_repeats_itself_only_if_told_to(name: str, world: Path, tmp_path: Path) -> None:
    command = CASES[name].text(world, tmp_path)
    succeed(command)
    written = contents(tmp_path)
    refused(command, "--overwrite")
    succeed(f"{command} --overwrite")
    assert contents(tmp_path) == written


# Commands whose output {link} is a link to an input; the name of the input in the world.
READ = {
    "scan": (f"{SCANS} --overwrite", "b.label", "pair/b.bin"),
    "scan as scores": (f"{SCANS} --scores --overwrite", "b.npz", "pair/b.bin"),
    "weights": (f"{SCANS} --overwrite", "b.label", "w.safetensors"),
    "true labels": (
        f"predict {{world}}/data {WEIGHTS} --out {{out}} --overwrite",
        FIRST,
        "data/sequences/08/labels/000001.label",
    ),
    "scores": (
        f"fuse {{world}}/data {SCORES} --out {{out}} --overwrite",
        FIRST,
        "predictions/sequences/08/predictions/000001.npz",
    ),
    "view": ("view {world}/pair/a.bin --html {out}/p.html --overwrite", "p.html", "pair/a.bin"),
    "labels": (
        "view {world}/pair/a.bin --labels {world}/a.label --html {out}/p.html --overwrite",
        "p.html",
        "a.label",
    ),
    "rank": (f"rank {{world}}/data {WEIGHTS} --out {{out}}/r.csv", "r.csv", "w.safetensors"),
    "export": (f"export {WEIGHTS} --out {{out}}", "range_net.onnx", "w.safetensors"),
    "evaluate": (f"evaluate {{world}}/data {WEIGHTS} --json {{out}}/m", "m", "w.safetensors"),
    "analyze": (f"analyze {{world}}/data {WEIGHTS} --out {{out}}", "tau.csv", "w.safetensors"),
    "bench": ("bench --scan {world}/pair/a.bin --json {out}/b", "b", "pair/a.bin"),
    "train": (
        "train semantickitti-compact --data {world}/data --out {out} --init {world}/w.safetensors",
        "weights.safetensors",
        "w.safetensors",
    ),
}


@pytest.mark.parametrize("is_hard", with_full([False, True], [True]))
@pytest.mark.parametrize("name", READ)
def test_no_output_is_an_input(name: str, is_hard: bool, world: Path, tmp_path: Path) -> None:
    command, output, read = READ[name]
    link = tmp_path / output
    link.parent.mkdir(parents=True, exist_ok=True)
    if is_hard:
        os.link(world / read, link)
    else:
        link.symlink_to(world / read)

    before = contents(world)
    refused(command.format(world=world, out=tmp_path), "found the input", str(link))
    assert contents(world) == before
    assert files(tmp_path) == {output}


@pytest.mark.parametrize("labels", [".label", "../truth/{name}.label"])
def test_labels_are_not_replaced_by_other_classes(labels: str, world: Path, tmp_path: Path) -> None:
    """Labels of other classes are not read. They are inputs all the same."""
    scan = tmp_path / "scans/a.bin"
    scan.parent.mkdir()
    shutil.copy(world / "pair/a.bin", scan)
    own = scan.parent / labels.replace("{name}", "a") if "/" in labels else scan.with_suffix(labels)
    own.parent.mkdir(exist_ok=True)
    own.resolve().write_bytes(LABELS)
    if "/" in labels:  # the place of the output is a link to the labels
        (tmp_path / "scans/a.label").symlink_to(own.resolve())
    description = {"classes": {"ground": 3}, "scans": "scans/*.bin", "labels": labels}
    (tmp_path / "own.yaml").write_text(json.dumps(description))

    before = contents(tmp_path)
    command = f"predict {tmp_path}/own.yaml {WEIGHTS} --out {tmp_path} --overwrite"
    refused(command.format(world=world), "a.label: expected an output that is not an input")
    assert contents(tmp_path) == before


def test_labels_of_another_folder_replace_no_labelled_scan(world: Path, tmp_path: Path) -> None:
    """Points that predict has labelled are a scan, too."""
    succeed(f"{SCANS} --format ply".format(world=world, out=tmp_path / "scans"))
    (tmp_path / "out").symlink_to(tmp_path / "scans")
    (tmp_path / "files").mkdir()
    (tmp_path / "files/a.ply").symlink_to(tmp_path / "scans/a.ply")
    before = contents(tmp_path / "scans")
    command = f"predict {tmp_path}/files {WEIGHTS} --out {tmp_path}/out --format ply --overwrite"
    refused(command.format(world=world), "found the input")
    assert contents(tmp_path / "scans") == before


@pytest.mark.parametrize("name", ["predict", "rank", "figures", "pictures", "view", "analyze"])
def test_a_read_only_folder_is_refused_before_the_work(
    name: str, world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    line = refusal(CASES[name].text(world, tmp_path / "new/out"))
    assert f"{tmp_path}: expected a folder to write to, found one that is read-only" in line
    assert not files(tmp_path)


def test_a_device_is_not_replaced(world: Path) -> None:
    line = refusal(f"evaluate {world}/data --predictions {world}/predictions --json /dev/null")
    assert "found a device" in line
    assert Path("/dev/null").is_char_device()


@pytest.mark.parametrize("name", ["recipe.yaml", "weights.safetensors", "rv/last.ckpt", "head/a"])
def test_a_run_takes_no_folder_with_files_so_named(name: str, world: Path, tmp_path: Path) -> None:
    mine = tmp_path / name
    mine.parent.mkdir(exist_ok=True)
    mine.write_bytes(MINE if "weights" not in name else (world / "w.safetensors").read_bytes())
    before = contents(tmp_path)
    line = refusal(f"train semantickitti-compact --data {world}/data --out {tmp_path} --resume")
    assert "a new folder or the folder of a run" in line
    assert contents(tmp_path) == before


def test_an_ablations_table_is_replaced_only_among_its_runs(world: Path, tmp_path: Path) -> None:
    (tmp_path / "ablation.csv").write_bytes(MINE)
    refused(f"ablate semantickitti-compact --data {world}/data --out {tmp_path}", "ablation.csv")
    assert contents(tmp_path) == {"ablation.csv": MINE}


@pytest.mark.parametrize(
    ("sensor", "name"),
    [("hdl64e", "sequences/01/velodyne/000000.bin"), ("hdl32e", "v1.0-trainval/scene.json")],
)
def test_simulated_scans_do_not_replace_real_ones(sensor: str, name: str, tmp_path: Path) -> None:
    new_file(tmp_path / name, MINE)
    line = refusal(f"simulate {tmp_path} --sensor {sensor} --sequences 2 --scans 1")
    assert "found something else" in line
    assert contents(tmp_path) == {name: MINE}


def test_export_keeps_to_it_before_it_exports(world: Path, tmp_path: Path) -> None:
    (tmp_path / DESCRIPTION).write_bytes(MINE)
    refused(f"export --weights {world}/w.safetensors --out {tmp_path}", DESCRIPTION)
    assert files(tmp_path) == {DESCRIPTION}


@pytest.mark.full
def test_export_replaces_its_graphs_if_told_to(world: Path, tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    command = f"export --weights {world}/w.safetensors --out {tmp_path}"
    succeed(command)
    succeed(f"{command} --overwrite")


def test_labels_in_the_folder_of_the_scans_stay(world: Path, tmp_path: Path) -> None:
    """`predict mylab --out mylab` is refused if there are labels already, and else is not."""
    shutil.copytree(world / "pair", tmp_path, dirs_exist_ok=True)
    (tmp_path / "a.label").write_bytes(MINE)
    command = f"predict {tmp_path} --weights {world}/w.safetensors --out {tmp_path}"
    refused(command, "a.label")
    assert files(tmp_path) == {"a.bin", "b.bin", "a.label"}

    (tmp_path / "a.label").unlink()
    succeed(command)


def test_what_a_killed_run_wrote_last_is_written_again(world: Path, tmp_path: Path) -> None:
    """The run was killed after it wrote a file, and before it noted that."""
    command = CASES["predict"].text(world, tmp_path)
    succeed(command)
    lines = (tmp_path / JOURNAL).read_text().splitlines(keepends=True)
    (tmp_path / JOURNAL).unlink()
    (tmp_path / UNFINISHED).write_text("".join(lines[:-1]))
    (tmp_path / "b.label").write_bytes(b"half")
    refused(command, "--overwrite")
    assert (tmp_path / "b.label").read_bytes() == b"half"

    succeed(f"{command} --resume")
    assert files(tmp_path) == {"a.label", "b.label"}
    assert (tmp_path / "b.label").read_bytes() != b"half"
    assert not (tmp_path / UNFINISHED).exists()


def test_resuming_keeps_corrected_labels_and_a_users_own(world: Path, tmp_path: Path) -> None:
    """Labels of a finished run may be corrected; those of a scan that is new are the user's."""
    scans = tmp_path / "scans"
    scans.mkdir()
    shutil.copy(world / "pair/a.bin", scans)
    out = tmp_path / "out"
    command = f"predict {scans} --weights {world}/w.safetensors --out {out} --resume"
    succeed(command)
    (out / "a.label").write_bytes(MINE)  # corrected
    succeed(command)

    shutil.copy(world / "pair/b.bin", scans)
    (out / "b.label").write_bytes(MINE)
    refused(command, "b.label")
    assert {(out / name).read_bytes() for name in files(out)} == {MINE}


def test_the_labels_of_a_broken_scan_stay_the_users(world: Path, tmp_path: Path) -> None:
    """`--overwrite` replaces only labels of scans that could be read."""
    out = tmp_path / "out"
    out.mkdir()
    shutil.copytree(world / "pair", tmp_path / "scans")
    (tmp_path / "scans/b.bin").write_bytes(b"truncated")
    (out / "b.label").write_bytes(LABELS)
    command = f"predict {tmp_path}/scans --weights {world}/w.safetensors --out {out}"
    code, error = run_cli(*shlex.split(f"{command} --overwrite"))
    assert code == 3
    assert "b.bin" in error
    assert (out / "b.label").read_bytes() == LABELS


def test_a_run_that_writes_nothing_leaves_no_folder(world: Path, tmp_path: Path) -> None:
    scan = new_file(tmp_path / "a.bin", b"truncated")
    refusal(f"predict {scan} --weights {world}/w.safetensors --out {tmp_path}/out")
    assert files(tmp_path) == {"a.bin"}
    assert not (tmp_path / "out").exists()


def test_the_message_counts_the_files(tmp_path: Path) -> None:
    paths = [tmp_path / name for name in ("a", "b", "c")]
    for path in paths:
        path.write_bytes(MINE)
    fails(lambda: check_outputs(dict.fromkeys(paths, ANYTHING)), tmp_path / "a", "and 2 more")


def test_a_folder_is_not_called_another_file(tmp_path: Path) -> None:
    fails(lambda: check_outputs({tmp_path: ANYTHING}, overwrite=True), tmp_path, "a folder")
