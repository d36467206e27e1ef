"""No command replaces a file that is not its own, and each may replace what it wrote."""

from __future__ import annotations

import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from amvnet.inference.journal import UNFINISHED
from amvnet.onnx_runner import DESCRIPTION
from amvnet.weights.file import save
from amvnet.written import RECORD, WrittenFiles, protecting

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
def test_a_command_repeats_itself_but_does_not_replace_what_was_changed(
    name: str, world: Path, tmp_path: Path
) -> None:
    case = CASES[name]
    command = case.text(world, tmp_path)
    succeed(command)
    succeed(command)

    path = tmp_path / case.file
    size = path.stat().st_size
    path.write_bytes(bytes(size))  # the size stays
    assert case.file in refusal(command)
    assert path.read_bytes() == bytes(size)


def test_export_keeps_to_it_before_it_exports(world: Path, tmp_path: Path) -> None:
    (tmp_path / DESCRIPTION).write_bytes(MINE)
    line = refusal(f"export --weights {world}/w.safetensors --out {tmp_path}")
    assert DESCRIPTION in line
    assert files(tmp_path) == {DESCRIPTION}


@pytest.mark.slow
def test_export_replaces_its_own(world: Path, tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    command = f"export --weights {world}/w.safetensors --out {tmp_path}"
    succeed(command)
    succeed(command)


def test_labels_in_the_folder_of_the_scans_stay(world: Path, tmp_path: Path) -> None:
    """`predict mylab --out mylab` is refused if there are labels already, and else is not."""
    shutil.copytree(world / "scans", tmp_path, dirs_exist_ok=True)
    (tmp_path / "a.label").write_bytes(MINE)
    command = f"predict {tmp_path} --weights {world}/w.safetensors --out {tmp_path}"
    assert "a.label" in refusal(command)
    assert files(tmp_path) == {"a.bin", "b.bin", "a.label"}

    (tmp_path / "a.label").unlink()
    succeed(command)
    succeed(command)


def test_runs_into_one_folder_know_each_others_files(world: Path, tmp_path: Path) -> None:
    for name in ("a", "b", "a", "b"):
        scan = f"{world}/scans/{name}.bin"
        succeed(f"predict {scan} --weights {world}/w.safetensors --out {tmp_path}")
    assert files(tmp_path) == {"a.label", "b.label"}


def test_what_a_killed_run_has_written_is_its_own(world: Path, tmp_path: Path) -> None:
    """The run was killed after it wrote a file, and before it noted that."""
    command = CASES["predict"].text(world, tmp_path)
    WrittenFiles(tmp_path).claim([Path("a.label"), Path("b.label")])
    (tmp_path / "a.label").write_bytes(b"half")
    succeed(f"{command} --resume")
    assert files(tmp_path) == {"a.label", "b.label"}
    assert not (tmp_path / UNFINISHED).exists()


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
    assert "b.label" in refusal(command)


def test_a_run_that_writes_nothing_leaves_no_folder(world: Path, tmp_path: Path) -> None:
    scan = tmp_path / "a.bin"
    scan.write_bytes(b"truncated")
    refusal(f"predict {scan} --weights {world}/w.safetensors --out {tmp_path}/out")
    assert files(tmp_path) == {"a.bin"}
    assert not (tmp_path / "out").exists()


# ---- the record


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "1", '{"a": 5}', '{"a": [1]}', '{"a": "x"}', "[" * 10**5, "\x00"]
)
def test_a_broken_record_protects_all(text: str, tmp_path: Path) -> None:
    (tmp_path / RECORD).write_text(text)
    (tmp_path / "a").write_bytes(MINE)
    fails(lambda: WrittenFiles(tmp_path).check([Path("a")]), "a", "--overwrite")
    WrittenFiles(tmp_path).finish([Path("a")])
    WrittenFiles(tmp_path).check([Path("a")])


def test_files_that_were_claimed_and_not_written_are_forgotten(tmp_path: Path) -> None:
    record = WrittenFiles(tmp_path)
    record.claim([Path("a"), Path("b")])
    (tmp_path / "b").write_bytes(b"b")
    record.finish([Path("a"), Path("b")])

    (tmp_path / "a").write_bytes(MINE)
    fails(lambda: WrittenFiles(tmp_path).check([Path("b"), Path("a")]), tmp_path / "a")
    WrittenFiles(tmp_path).check([Path("b")])


def test_the_message_counts_the_files(tmp_path: Path) -> None:
    paths = [Path("a"), Path("b"), Path("c")]
    for path in paths:
        (tmp_path / path).write_bytes(MINE)
    fails(lambda: WrittenFiles(tmp_path).check(paths), tmp_path / "a", "and 2 more")


def test_a_folder_is_not_called_another_file(tmp_path: Path) -> None:
    fails(lambda: WrittenFiles(tmp_path.parent).check([Path(tmp_path.name)]), tmp_path, "a folder")


def failing(call: Callable[[], None], folder: Path) -> None:
    with protecting([folder / "a"]):
        call()


def test_a_file_that_a_command_could_write_and_does_not_stays_the_users(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(MINE)
    (tmp_path / "b").write_bytes(MINE)
    with protecting([tmp_path / "a", tmp_path / "b"], overwrite=True):
        (tmp_path / "a").write_bytes(b"of the command")
    WrittenFiles(tmp_path).check([Path("a")])
    fails(lambda: WrittenFiles(tmp_path).check([Path("b")]), tmp_path / "b")


def test_a_command_that_fails_lists_nothing(tmp_path: Path) -> None:
    def fail() -> None:
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space"):
        failing(fail, tmp_path)
    assert not (tmp_path / RECORD).exists()


CLAIM = """
import sys
from pathlib import Path
from amvnet.written import WrittenFiles

for index in range(50):
    path = Path(f"{sys.argv[2]}-{index}")
    (Path(sys.argv[1]) / path).write_text("labels")
    WrittenFiles(Path(sys.argv[1])).finish([path])
"""


def test_processes_that_write_into_one_folder_keep_each_others_entries(tmp_path: Path) -> None:
    pytest.importorskip("fcntl")
    processes = [
        subprocess.Popen([sys.executable, "-c", CLAIM, tmp_path, name]) for name in ("a", "b", "c")
    ]
    assert [process.wait() for process in processes] == [0, 0, 0]
    written = [Path(f"{name}-{index}") for name in ("a", "b", "c") for index in range(50)]
    WrittenFiles(tmp_path).check(written)
