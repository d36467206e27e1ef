"""A fleet on a Ray cluster: the labels of `predict`, whatever is killed on the way."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from io import BytesIO
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import pytest

ray = pytest.importorskip("ray")

from amvnet.errors import InputError, SomeBroken  # noqa: E402
from amvnet.fleet import pipeline  # noqa: E402
from amvnet.fleet.labelling import IS_FATAL  # noqa: E402
from amvnet.fleet.pipeline import Cluster, FleetRun, connect  # noqa: E402
from amvnet.fleet.results import DRIVES_SCHEMA, Results, results_schema  # noqa: E402
from amvnet.fleet.storage import Place  # noqa: E402
from amvnet.inference.request import LabellingRequest  # noqa: E402
from amvnet.weights.file import load, save  # noqa: E402

from fixtures.commands import fails, refusal, refused, run_cli  # noqa: E402
from fixtures.processes import PATIENCE  # noqa: E402
from fixtures.s3_server import Bucket, held_labels  # noqa: E402
from fixtures.tiny import fresh_weights  # noqa: E402

pytestmark = [
    pytest.mark.full,
    # `connect` ignores it too, for the process of a command.
    pytest.mark.filterwarnings("ignore:`ray_remote_args` is deprecated"),
]
WRITTEN = 8  # label files that are written before a run is stopped; some blocks are then whole

CLI = """
import sys
from amvnet.cli.main import main
from amvnet.fleet import pipeline, results

pipeline.BLOCK = 2
results.PART_SECONDS = 0.0  # every block at once
sys.exit(main())
"""


@pytest.fixture(scope="module")
def ray_here(bucket: Bucket) -> Iterator[None]:
    """A cluster in this machine, whose workers know the bucket."""
    connect()
    yield
    ray.shutdown()


def command(fleet: Path, out: str, *options: str, inputs: str = "s3://fleet/scans") -> list[str]:
    weights = f"{fleet}/w.safetensors"
    return ["fleet", inputs, "--weights", weights, "--out", out, "--workers", "2", *options]


def table(bucket: Bucket, out: str) -> pa.Table:
    parts = [key for key in bucket.keys(out) if "part-" in key]
    return pa.concat_tables(
        pa.parquet.read_table(BytesIO(bucket[f"{out}/{part}"])) for part in sorted(parts)
    )


def check_complete(bucket: Bucket, out: str, labels: dict[str, bytes]) -> None:
    """Check that a folder of the bucket has all labels, and one row for each scan."""
    for name, content in labels.items():
        assert bucket[f"{out}/{name}"] == content, name
    rows = table(bucket, out)
    assert sorted(rows["scan"].to_pylist()) == sorted(name[: -len(".label")] for name in labels)
    assert rows["error"].null_count == len(rows)


# ---- whole runs


def test_a_fleet_has_the_labels_of_predict_and_a_later_run_does_only_what_is_left(
    ray_here: None,
    fleet: Path,
    bucket: Bucket,
    labels: dict[str, bytes],
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run_cli(*command(fleet, "s3://fleet/out")) == (0, "")
    check_complete(bucket, "out", labels)
    before = {row["scan"]: row for row in table(bucket, "out").to_pylist()}

    # A new drive, a scan of which is broken; and a label file that is gone.
    bucket.upload(fleet / "scans/drive0", "scans/drive9")
    bucket["scans/drive9/000002.bin"] = b"123"
    bucket.remove("out/drive1/000003.label")
    code, error = run_cli(*command(fleet, "s3://fleet/out", "--resume"))
    assert code == 3
    broken, summary = error.splitlines()
    assert broken.startswith("amvnet: s3://fleet/scans/drive9/000002.bin: expected")
    assert "23 of 24 scans are labelled, 1 cannot be used" in summary
    after = {row["scan"]: row for row in table(bucket, "out").to_pylist()}
    assert {name for name in before if after[name] != before[name]} == {"drive1/000003"}

    bucket["scans/drive9/000002.bin"] = (fleet / "scans/drive0/000002.bin").read_bytes()
    capsys.readouterr()
    assert run_cli(*command(fleet, "s3://fleet/out", "--resume")) == (0, "")
    assert "24 label files in s3://fleet/out" in capsys.readouterr().out
    more = {name.replace("0", "9", 1): content for name, content in labels.items()}
    more = {name: content for name, content in more.items() if name.startswith("drive9")}
    check_complete(bucket, "out", labels | more)
    for key in list(bucket.keys("scans/drive9")):
        bucket.remove(f"scans/drive9/{key}")


def test_a_manifest_with_odd_rows_labels_the_others(
    ray_here: None, fleet: Path, tmp_path: Path, labels: dict[str, bytes]
) -> None:
    """A row is a folder, one a file that is gone, one has a name outside the output folder."""
    paths = sorted((fleet / "scans/drive2").glob("*.bin"))
    names = [f"./good//{path.stem}" for path in paths]
    odd = {"folder": fleet / "scans", "gone": fleet / "gone.bin", "../outside": paths[0]}
    columns = {
        "path": [*map(str, [*paths, *odd.values()])],
        "name": [*names, *odd],
        "drive": ["2"] * len(names) + ["odd"] * len(odd),
    }
    manifest = tmp_path / "m.csv"
    pa.csv.write_csv(pa.table(columns), manifest)
    out = tmp_path / "out"
    code, error = run_cli(*command(fleet, str(out), inputs=str(manifest)))
    assert code == 3
    assert len(error.splitlines()) == 1 + len(odd)
    assert "4 of 7 scans are labelled, 3 cannot be used" in error
    for path in paths:
        assert (out / f"good/{path.stem}.label").read_bytes() == labels[f"drive2/{path.stem}.label"]
    assert not (tmp_path / "outside.label").exists()


def test_a_label_that_is_gone_at_the_end_is_not_counted(
    ray_here: None, fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    finish = FleetRun.finish

    def remove_and_finish(run: FleetRun) -> int:
        run.results.flush()
        (tmp_path / "000001.label").unlink()
        return finish(run)

    monkeypatch.setattr(FleetRun, "finish", remove_and_finish)
    code, error = run_cli(*command(fleet, str(tmp_path), inputs=str(fleet / "scans/drive0")))
    assert code == 3
    assert "000001.bin: expected its labels" in error
    assert "3 of 4 scans are labelled, 1 cannot be used" in error


@pytest.mark.parametrize("what", ["worker", "driver"])
def test_what_is_killed_is_made_up_for(
    fleet: Path, bucket: Bucket, labels: dict[str, bytes], what: str
) -> None:
    """With SIGKILL, in the middle of a run."""
    out = f"kill-{what}"
    words = command(fleet, f"s3://fleet/{out}")
    with held_labels(WRITTEN) as go_on:
        process = start(words)
        if what == "worker":
            wait_for(lambda: any(key.endswith(".label") for key in bucket.keys(out)), process)
            os.kill(workers_of(process.pid)[0], signal.SIGKILL)
            go_on()
        else:
            wait_for(lambda: any("part-" in key for key in bucket.keys(out)), process)
            process.kill()
        code = process.wait()

    if what == "driver":
        assert code == -signal.SIGKILL
        before = table(bucket, out)
        assert 0 < len(before) < len(labels)
        assert start([*words, "--resume"]).wait() == 0
        after = table(bucket, out).to_pylist()
        assert all(row in after for row in before.to_pylist())  # done only once
    else:
        assert code == 0
    check_complete(bucket, out, labels)


@pytest.mark.usefixtures("hears_sigint")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_all_with_one_line(fleet: Path, bucket: Bucket, number: int) -> None:
    out = f"stop-{number}"
    with held_labels(WRITTEN):
        process = subprocess.Popen(
            [sys.executable, "-c", CLI, *command(fleet, f"s3://fleet/{out}")],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        wait_for(lambda: any("part-" in key for key in bucket.keys(out)), process)
        workers = workers_of(process.pid)
        process.send_signal(number)
        _, error = process.communicate(timeout=PATIENCE)
    assert process.returncode == 128 + number
    lines = [line for line in error.splitlines() if line.startswith("amvnet")]
    assert lines == ["amvnet: stopped; go on with --resume"]
    assert "Traceback" not in error

    deadline = time.monotonic() + PATIENCE  # comes only if workers outlive the run
    while any(Path(f"/proc/{worker}").exists() for worker in workers):
        assert time.monotonic() < deadline, "workers outlive the run"
        time.sleep(0.5)  # between two looks


def test_a_signal_while_ray_starts_is_not_lost() -> None:
    """Ray's own handler of SIGTERM exits without a message."""
    heard: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda number, _: heard.append(number))
    try:
        with pipeline._own_signals():
            signal.signal(signal.SIGTERM, lambda number, _: sys.exit(number))
            signal.raise_signal(signal.SIGTERM)
    finally:
        signal.signal(signal.SIGTERM, before)
    assert heard == [signal.SIGTERM]


def start(words: list[str]) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-c", CLI, *words], stdout=subprocess.DEVNULL)


def wait_for(is_reached: Callable[[], bool], process: subprocess.Popen[Any]) -> None:
    """Wait until a run has come so far, which it does before it is over, as labels are held."""
    while not is_reached():
        assert process.poll() is None, "the run was over before it was killed"
        time.sleep(0.2)  # between two looks


def workers_of(driver: int) -> list[int]:
    """Return the processes of a driver's workers that label scans."""
    parents = {}
    workers = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            words = (folder / "stat").read_text().rpartition(")")[2].split()
            title = (folder / "cmdline").read_bytes()
        except OSError:
            continue
        parents[int(folder.name)] = int(words[1])
        if title.startswith(b"ray::") and b"Worker" in title:
            workers.append(int(folder.name))

    def is_descendant(process: int) -> bool:
        return process == driver or (process in parents and is_descendant(parents[process]))

    return [worker for worker in workers if is_descendant(worker)]


# ---- what cannot work


def test_wrong_input_is_one_line_before_a_cluster_is_started(
    fleet: Path, bucket: Bucket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ray, "init", lambda **_: pytest.fail("Ray was started"))
    weights = f"--weights {fleet}/w.safetensors"
    for text, words in (
        (f"s3://fleet/none {weights} --out s3://fleet/x", ("s3://fleet/none",)),
        (f"s3://none/scans {weights} --out s3://fleet/x", ("s3://none/scans",)),
        (f"{fleet}/scans {weights} --out {fleet}/scans/x", ("--out",)),
        (f"{fleet}/scans {weights} --out x --address scans", ("address", "scans")),
        (f"{fleet}/scans {weights} --out x --workers 0", ("--workers", "found '0'")),
        (f"{fleet}/scans {weights} --out x --topic points", ("--topic",)),
        (f"{fleet}/scans {weights} --out x --method rv --uncertain", ("--uncertain",)),
        (f"simulated-hdl64e:{fleet} {weights} --out x", ("dataset", "amvnet predict")),
    ):
        line = refusal(f"fleet {text}")
        for word in words:
            assert word in line, line
    for text in (
        f"predict s3://k:pw@fleet/scans {weights} --out x",
        f"predict {fleet}/scans {weights} --out s3://k:pw@fleet/x",
    ):
        line = refusal(text)
        assert "amvnet fleet" in line
        assert "pw" not in line


def test_a_useless_output_folder_is_one_line(ray_here: None, fleet: Path, bucket: Bucket) -> None:
    other = save(fresh_weights(seed=1), fleet / "other.safetensors")
    out = "s3://fleet/earlier-2"
    Results(Place.of(out), LabellingRequest(load(fleet / "w.safetensors"), precision="float32"))
    weights = f"--weights {fleet}/w.safetensors"
    for text, words in (
        (f"{weights} --out s3://none/x", ("s3://none/x", "credentials")),
        (f"{weights} --out {out}", ("--resume",)),
        (f"--weights {other} --out {out} --resume", ("other values of weights;",)),
    ):
        line = refusal(f"fleet s3://fleet/scans {text}")
        for word in words:
            assert word in line, line


def test_missing_credentials_are_one_line_and_exit_code_2(fleet: Path, locked_bucket: str) -> None:
    weights = f"--weights {fleet}/w.safetensors"
    refused(f"fleet {locked_bucket}/scans {weights} --out x", "credentials")


def scans_of(drive: str, *names: str) -> pa.Table:
    rows = [{"path": f"{name}.bin", "name": name, "drive": drive} for name in names]
    return pa.Table.from_pylist(rows)


def run_in(fleet: Path, folder: Path) -> FleetRun:
    request = LabellingRequest(load(fleet / "w.safetensors"))
    results = Results(Place.of(str(folder)), request)
    return FleetRun(request, results, Cluster(workers=1), {"num_cpus": 1})


def test_two_scans_that_write_one_file_are_refused(fleet: Path, tmp_path: Path) -> None:
    run = run_in(fleet, tmp_path)
    run.plan(scans_of("a", "1", "2"))
    fails(lambda: run.plan(scans_of("b", "3", "2")), "found 2 twice")
    run = run_in(fleet, tmp_path / "b")
    fails(lambda: run.plan(scans_of("b", "3", "2", "3")), "found 3 twice")


def test_only_labels_of_the_scans_of_this_run_are_counted(fleet: Path, tmp_path: Path) -> None:
    run = run_in(fleet, tmp_path)
    rows = []
    for name in ("1", "2", "3"):
        row = {"scan": name, "drive": "a", "path": f"{name}.bin", "labels": f"{name}.label"}
        rows.append(row | {"points": 9, "uncertain": 0.0})
        (tmp_path / f"{name}.label").write_bytes(bytes(36))
    run.results.add(pa.Table.from_pylist(rows, results_schema(run.request.taxonomy)))
    run.results.flush()
    run.plan(scans_of("a", "1", "3"))
    assert run.finish() == 2


def test_scans_of_one_drive_follow_one_another_with_its_estimates() -> None:
    scans = pa.concat_tables([scans_of("a", "1", "2"), scans_of("b", "3"), scans_of("a", "4")])
    rows = pipeline._with_estimates(scans, {"a": "A", "b": "B"}).to_pylist()
    assert [row["name"] + row["estimates"] for row in rows] == ["1A", "2A", "4A", "3B"]


# ---- workers that fail


class Mortal:
    """A worker in place of `LabelScans`, which a scan named poison kills."""

    def __init__(self, request: LabellingRequest, out: str, *options: object) -> None:
        self.schema = results_schema(request.taxonomy).append(IS_FATAL)
        self.out = Path(out)

    def __call__(self, batch: pa.Table) -> pa.Table:
        names = batch["name"].to_pylist()
        if "poison" in names:
            os.kill(os.getpid(), signal.SIGKILL)
        values = {"points": 1, "uncertain": 0.0, "drive": "a", "is_fatal": "full" in names}
        error = "/full/disk: No space left" if "full" in names else None
        for name in names:
            (self.out / f"{name}.label").touch()
        rows = [{"scan": name, "error": error, **values} for name in names]
        return pa.Table.from_pylist(rows, self.schema)


class Measuring:
    """A worker in place of `MeasureSensors`."""

    def __init__(self, request: LabellingRequest) -> None:
        pass

    def __call__(self, batch: pa.Table) -> pa.Table:
        drives = sorted(set(batch["drive"].to_pylist()))
        return pa.Table.from_pylist(
            [{"drive": d, "estimates": "null"} for d in drives], DRIVES_SCHEMA
        )


@pytest.fixture
def mortal(ray_here: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers that can be killed, with blocks of two scans."""
    ray.cloudpickle.register_pickle_by_value(sys.modules[__name__])
    monkeypatch.setattr(pipeline, "LabelScans", Mortal)
    monkeypatch.setattr(pipeline, "MeasureSensors", Measuring)
    monkeypatch.setattr(pipeline, "BLOCK", 2)
    monkeypatch.setattr(pipeline, "MEASURED_SCANS", 1)
    monkeypatch.setattr(pipeline, "RETRIES", 1)


def label(run: FleetRun, scans: pa.Table) -> None:
    remaining = run.plan(scans)
    run.measure(scans)
    run.label(remaining)
    run.results.flush()


def rows_in(folder: Path) -> list[dict[str, object]]:
    rows: list[dict[str, object]] = pa.parquet.read_table(
        sorted(folder.glob("results/part-*"))
    ).to_pylist()
    return rows


def test_a_scan_that_ends_workers_is_broken(mortal: None, fleet: Path, tmp_path: Path) -> None:
    run = run_in(fleet, tmp_path)
    label(run, scans_of("a", "1", "poison", "2", "3", "4"))
    rows = rows_in(tmp_path)
    errors = {row["scan"]: row["error"] for row in rows}
    assert len(rows) == len(errors) == 5
    assert [name for name, error in errors.items() if error] == ["poison"]
    with pytest.raises(SomeBroken, match="4 of 5 scans are labelled, 1 cannot be used") as caught:
        run.finish()
    assert "ends its reader" in caught.value.faults[0]


def test_workers_that_end_again_and_again_are_one_line(
    mortal: None, fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pipeline, "MAX_LOST_BLOCKS", 0)
    fails(lambda: label(run_in(fleet, tmp_path), scans_of("a", "poison", "1")), "expected workers")


def test_a_full_disk_ends_it_and_keeps_labels(mortal: None, fleet: Path, tmp_path: Path) -> None:
    run = run_in(fleet, tmp_path)
    with pytest.raises(OSError, match="No space left") as caught:
        label(run, scans_of("a", "1", "2", "full", "3"))
    assert caught.value.filename == "/full/disk"
    run.results.flush()
    assert {row["scan"] for row in rows_in(tmp_path)} <= {"1", "2"}


class Reluctant(Mortal):
    """A worker that never starts."""

    def __init__(self, request: LabellingRequest, out: str, *options: object) -> None:
        raise InputError("expected a library on this machine, found none; install it")


def test_a_ray_that_starts_here_reports_nothing_of_its_use() -> None:
    try:
        usage = import_module("ray._common.usage.usage_lib")
    except ModuleNotFoundError:  # its place in earlier versions
        usage = import_module("ray._private.usage.usage_lib")
    assert not usage.usage_stats_enabled()


def test_workers_that_cannot_start_are_one_line(
    mortal: None, fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pipeline, "LabelScans", Reluctant)
    run = run_in(fleet, tmp_path)
    fails(lambda: label(run, scans_of("a", "1")), "expected a library", "install it")


# ---- many scans


def test_windows_hold_as_many_scans_as_a_plan(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline, "WINDOW", 3)

    def sizes(lengths: Sequence[int]) -> list[int]:
        tables = [scans_of("a", *map(str, range(length))) for length in lengths]
        return [len(window) for window in pipeline._windows(iter(tables))]

    assert sizes([1, 1, 1, 2, 2, 1]) == [3, 4, 1]
    assert sizes([3]) == [3]
