"""No command replaces a file without --overwrite, and --resume goes on with what is there."""

from __future__ import annotations

import shlex
import shutil
from dataclasses import dataclass
from pathlib import Path

import pytest

from amvnet.files import check_free
from amvnet.inference.journal import JOURNAL, UNFINISHED
from amvnet.onnx_runner import DESCRIPTION
from amvnet.weights.file import save

from fixtures.worlds import (
    fails,
    files,
    fresh_weights,
    make_streets,
    refusal,
    run_cli,
    street,
    succeed,
)

MINE = b"hours of work"


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset, lone scans, weights and predictions of the dataset with scores."""
    root = tmp_path_factory.mktemp("world")
    make_streets(root / "data", ("08",))
    save(fresh_weights(), root / "w.safetensors")
    (root / "scans").mkdir()
    for name in ("a", "b"):
        street(ord(name), 300)[0].tofile(root / f"scans/{name}.bin")
    succeed(f"predict {root}/data --weights {root}/w.safetensors --scores --out {root}/predictions")
    return root


@dataclass(frozen=True)
class Case:
    """A command, and a file that it writes, relative to the folder of its output."""

    command: str
    file: str

    def text(self, world: Path, out: Path) -> str:
        return self.command.format(world=world, out=out)


WEIGHTS = "--weights {world}/w.safetensors"
SCORES = "--scores-a {world}/predictions --scores-b {world}/predictions"
CASES = {
    "predict": Case(f"predict {{world}}/scans {WEIGHTS} --out {{out}}", "b.label"),
    "ply": Case(f"predict {{world}}/scans {WEIGHTS} --out {{out}} --format ply", "b.ply"),
    "scores": Case(f"predict {{world}}/scans {WEIGHTS} --out {{out}} --scores", "a.npz"),
    "uncertain": Case(
        f"predict {{world}}/scans {WEIGHTS} --out {{out}} --uncertain", "a.uncertain.npy"
    ),
    "dataset": Case(
        f"predict {{world}}/data {WEIGHTS} --out {{out}}", "sequences/08/predictions/000001.label"
    ),
    "fuse": Case(
        f"fuse {{world}}/data {SCORES} --out {{out}}", "sequences/08/predictions/000000.label"
    ),
    "rank": Case(f"rank {{world}}/data {WEIGHTS} --out {{out}}/r.csv --split all", "r.csv"),
    "submit": Case(
        "submit {world}/data --predictions {world}/predictions --split val --out {out}/e.zip",
        "e.zip",
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_a_users_file_stays_and_nothing_is_written(name: str, world: Path, tmp_path: Path) -> None:
    case = CASES[name]
    mine = tmp_path / case.file
    mine.parent.mkdir(parents=True, exist_ok=True)
    mine.write_bytes(MINE)

    line = refusal(case.text(world, tmp_path))
    assert case.file in line
    assert "--overwrite" in line
    assert mine.read_bytes() == MINE
    assert files(tmp_path) == {case.file}

    succeed(case.text(world, tmp_path) + " --overwrite")
    assert mine.read_bytes() != MINE


@pytest.mark.parametrize("name", ["predict", "dataset", "fuse", "rank", "submit"])
def test_a_command_repeats_itself_only_if_told_to(name: str, world: Path, tmp_path: Path) -> None:
    case = CASES[name]
    command = case.text(world, tmp_path)
    succeed(command)
    written = (tmp_path / case.file).read_bytes()
    assert "--overwrite" in refusal(command)
    succeed(f"{command} --overwrite")
    assert (tmp_path / case.file).read_bytes() == written


def test_export_keeps_to_it_before_it_exports(world: Path, tmp_path: Path) -> None:
    (tmp_path / DESCRIPTION).write_bytes(MINE)
    line = refusal(f"export --weights {world}/w.safetensors --out {tmp_path}")
    assert DESCRIPTION in line
    assert files(tmp_path) == {DESCRIPTION}


@pytest.mark.slow
def test_export_replaces_its_graphs_if_told_to(world: Path, tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    command = f"export --weights {world}/w.safetensors --out {tmp_path}"
    succeed(command)
    succeed(f"{command} --overwrite")


def test_labels_in_the_folder_of_the_scans_stay(world: Path, tmp_path: Path) -> None:
    """`predict mylab --out mylab` is refused if there are labels already, and else is not."""
    shutil.copytree(world / "scans", tmp_path, dirs_exist_ok=True)
    (tmp_path / "a.label").write_bytes(MINE)
    command = f"predict {tmp_path} --weights {world}/w.safetensors --out {tmp_path}"
    assert "a.label" in refusal(command)
    assert files(tmp_path) == {"a.bin", "b.bin", "a.label"}

    (tmp_path / "a.label").unlink()
    succeed(command)


def test_two_runs_share_a_folder_if_their_scans_differ(world: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        scan = f"{world}/scans/{name}.bin"
        succeed(f"predict {scan} --weights {world}/w.safetensors --out {tmp_path}")
    assert files(tmp_path) == {"a.label", "b.label"}


def test_what_a_killed_run_wrote_last_is_written_again(world: Path, tmp_path: Path) -> None:
    """The run was killed after it wrote a file, and before it noted that."""
    command = CASES["predict"].text(world, tmp_path)
    succeed(command)
    lines = (tmp_path / JOURNAL).read_text().splitlines(keepends=True)
    (tmp_path / JOURNAL).unlink()
    (tmp_path / UNFINISHED).write_text("".join(lines[:-1]))
    (tmp_path / "b.label").write_bytes(b"half")

    succeed(f"{command} --resume")
    assert files(tmp_path) == {"a.label", "b.label"}
    assert (tmp_path / "b.label").read_bytes() != b"half"
    assert not (tmp_path / UNFINISHED).exists()


def test_resuming_keeps_corrected_labels_and_a_users_own(world: Path, tmp_path: Path) -> None:
    """Labels of a finished run may be corrected; those of a scan that is new are the user's."""
    scans = tmp_path / "scans"
    scans.mkdir()
    shutil.copy(world / "scans/a.bin", scans)
    out = tmp_path / "out"
    command = f"predict {scans} --weights {world}/w.safetensors --out {out} --resume"
    succeed(command)
    (out / "a.label").write_bytes(MINE)
    succeed(command)

    shutil.copy(world / "scans/b.bin", scans)
    (out / "b.label").write_bytes(MINE)
    assert "b.label" in refusal(command)
    assert {(out / name).read_bytes() for name in files(out)} == {MINE}


def test_the_labels_of_a_broken_scan_stay_the_users(world: Path, tmp_path: Path) -> None:
    """`--overwrite` replaces only labels of scans that could be read."""
    out = tmp_path / "out"
    out.mkdir()
    shutil.copytree(world / "scans", tmp_path / "scans")
    (tmp_path / "scans/b.bin").write_bytes(b"truncated")
    (out / "b.label").write_bytes(MINE)
    command = f"predict {tmp_path}/scans --weights {world}/w.safetensors --out {out}"
    code, error = run_cli(*shlex.split(f"{command} --overwrite"))
    assert code == 3
    assert "b.bin" in error
    assert (out / "b.label").read_bytes() == MINE


def test_a_run_that_writes_nothing_leaves_no_folder(world: Path, tmp_path: Path) -> None:
    scan = tmp_path / "a.bin"
    scan.write_bytes(b"truncated")
    refusal(f"predict {scan} --weights {world}/w.safetensors --out {tmp_path}/out")
    assert files(tmp_path) == {"a.bin"}
    assert not (tmp_path / "out").exists()


def test_the_message_counts_the_files(tmp_path: Path) -> None:
    paths = [tmp_path / name for name in ("a", "b", "c")]
    for path in paths:
        path.write_bytes(MINE)
    fails(lambda: check_free(paths), tmp_path / "a", "and 2 more")


def test_a_folder_is_not_called_another_file(tmp_path: Path) -> None:
    fails(lambda: check_free([tmp_path]), tmp_path, "a folder")
