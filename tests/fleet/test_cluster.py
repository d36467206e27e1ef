"""A fleet on a Ray cluster: the labels of `predict`, whatever is killed on the way."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from io import BytesIO
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet
import pytest

ray = pytest.importorskip("ray")

from amvnet.errors import InputError, SomeBroken  # noqa: E402
from amvnet.fleet import workers as workers_module  # noqa: E402
from amvnet.fleet.actors import Labelling, results_schema  # noqa: E402
from amvnet.fleet.cluster import FleetRun  # noqa: E402
from amvnet.fleet.results import Results  # noqa: E402
from amvnet.fleet.storage import Place  # noqa: E402
from amvnet.fleet.workers import Workers, connect  # noqa: E402
from amvnet.weights.file import load, save  # noqa: E402

from fixtures.s3_server import Bucket, slow_labels  # noqa: E402
from fixtures.worlds import fails, fresh_weights, refusal, run_cli  # noqa: E402

pytestmark = pytest.mark.slow

CLI = """
import sys
from amvnet.cli.main import main
from amvnet.fleet import results

results.PART_SECONDS = 0.0  # every block at once
sys.exit(main())
"""


@pytest.fixture(scope="module")
def ray_here(bucket: Bucket) -> Iterator[None]:
    """A cluster in this machine, whose workers know the bucket."""
    connect()
    yield
    ray.shutdown()


def command(fleet: Path, out: str, options: str = "") -> list[str]:
    """Return the words that label the scans of the bucket."""
    text = f"predict s3://fleet/scans --weights {fleet}/w.safetensors --out {out} {options}"
    return [*text.split(), "--workers", "2", "--ray"]


def table(bucket: Bucket, out: str) -> pa.Table:
    """Return the table of results in the bucket."""
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


def test_a_fleet_has_the_labels_of_predict_and_a_later_run_does_only_what_is_new(
    ray_here: None, fleet: Path, bucket: Bucket, labels: dict[str, bytes]
) -> None:
    assert run_cli(*command(fleet, "s3://fleet/out")) == (0, "")
    check_complete(bucket, "out", labels)
    parts = {key: bucket[f"out/{key}"] for key in bucket.keys("out") if "part-" in key}

    # A new drive, one scan of which is broken.
    bucket.upload(fleet / "scans/drive0", "scans/drive9")
    bucket["scans/drive9/000002.bin"] = b"123"
    code, error = run_cli(*command(fleet, "s3://fleet/out", "--resume"))
    assert code == 3
    broken, summary = error.splitlines()
    assert broken.startswith("amvnet: s3://fleet/scans/drive9/000002.bin: expected")
    assert "23 of 24 scans segmented, 1 broken" in summary
    assert parts.items() <= {key: bucket[f"out/{key}"] for key in bucket.keys("out")}.items()

    bucket["scans/drive9/000002.bin"] = (fleet / "scans/drive0/000002.bin").read_bytes()
    assert run_cli(*command(fleet, "s3://fleet/out", "--resume")) == (0, "")
    more = {name.replace("0", "9", 1): content for name, content in labels.items()}
    more = {name: content for name, content in more.items() if name.startswith("drive9")}
    check_complete(bucket, "out", labels | more)
    for key in list(bucket.keys("scans/drive9")):
        bucket.remove(f"scans/drive9/{key}")


@pytest.mark.parametrize("what", ["worker", "driver"])
def test_what_is_killed_is_made_up_for(
    fleet: Path, bucket: Bucket, labels: dict[str, bytes], what: str
) -> None:
    """With SIGKILL, in the middle of a run of two workers."""
    out = f"kill-{what}"
    words = command(fleet, f"s3://fleet/{out}")
    with slow_labels(0.5):
        process = start(words)
        if what == "worker":
            wait_for(lambda: any(key.endswith(".label") for key in bucket.keys(out)), process)
            workers = workers_of(process.pid)
            assert len(workers) == 2
            os.kill(workers[0], signal.SIGKILL)
        else:
            wait_for(lambda: any("part-" in key for key in bucket.keys(out)), process)
            process.kill()
    code = process.wait()

    if what == "driver":
        assert code == -signal.SIGKILL
        before = table(bucket, out)
        assert 0 < len(before) < len(labels)
        assert start([*words[:-3], "--resume", *words[-3:]]).wait() == 0
        after = table(bucket, out).to_pylist()
        assert all(row in after for row in before.to_pylist())  # done only once
    else:
        assert code == 0
    check_complete(bucket, out, labels)


def start(words: list[str]) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-c", CLI, *words], stdout=subprocess.DEVNULL)


def wait_for(is_reached: Callable[[], bool], process: subprocess.Popen[bytes]) -> None:
    """Wait until a run has come so far."""
    while not is_reached():
        assert process.poll() is None, "the run was over before it was killed"
        time.sleep(0.2)


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
        if title.startswith(b"ray::") and b"LabelScans" in title:
            workers.append(int(folder.name))

    def is_descendant(process: int) -> bool:
        return process == driver or (process in parents and is_descendant(parents[process]))

    return [worker for worker in workers if is_descendant(worker)]


# ---- what cannot work


def test_wrong_input_is_one_line_before_a_cluster_is_started(fleet: Path, bucket: Bucket) -> None:
    other = save(fresh_weights(seed=1), fleet / "other.safetensors")
    Results(Place.of("s3://fleet/earlier"), labelling_of(fleet, "s3://fleet/earlier").settings)
    weights = f"--weights {fleet}/w.safetensors"
    for text, words in (
        (f"s3://fleet/none {weights} --out s3://fleet/x --ray", ("s3://fleet/none",)),
        (f"s3://none/scans {weights} --out s3://fleet/x --ray", ("s3://none/scans",)),
        (f"s3://fleet/scans {weights} --out s3://none/x --ray", ("s3://none/x", "credentials")),
        (f"s3://fleet/scans {weights} --out s3://fleet/earlier --ray", ("--resume",)),
        (
            f"s3://fleet/scans --weights {other} --out s3://fleet/earlier --resume --ray",
            ("another weights;",),
        ),
        (f"{fleet}/scans {weights} --out {fleet}/scans/x --format ply --ray", ("--out",)),
        (f"{fleet}/scans {weights} --out x --ray scans", ("address", "scans", "before --ray")),
        (f"{fleet}/scans {weights} --out x --ray --workers 0", ("--workers", "found '0'")),
        (f"{fleet}/scans {weights} --out x --ray --topic points", ("--topic",)),
        (f"simulated-hdl64e:{fleet} {weights} --out x --ray", ("dataset", "without --ray")),
        (f"s3://fleet/scans {weights} --out x", ("s3://fleet/scans", "say --ray")),
        (f"{fleet}/scans {weights} --out s3://fleet/x", ("s3://fleet/x", "say --ray")),
    ):
        line = refusal(f"predict {text}")
        for word in words:
            assert word in line, line


def test_missing_credentials_are_one_line_and_exit_code_2(fleet: Path, locked_bucket: str) -> None:
    weights = f"--weights {fleet}/w.safetensors"
    line = refusal(f"predict {locked_bucket}/scans {weights} --out x --ray")
    assert "credentials" in line


def labelling_of(fleet: Path, out: str) -> Labelling:
    return Labelling(load(fleet / "w.safetensors"), out)


def block_of(drive: str, *names: str) -> pa.Table:
    rows = [{"path": f"{name}.bin", "name": name, "drive": drive} for name in names]
    return pa.Table.from_pylist(rows)


class Unused:
    """Workers that are not needed."""


def test_two_scans_of_one_name_are_refused(fleet: Path, tmp_path: Path) -> None:
    labelling = labelling_of(fleet, str(tmp_path))
    run = FleetRun(labelling, Results(Place.of(str(tmp_path)), {}), Unused())  # type: ignore[arg-type]
    fails(lambda: run.plan([block_of("a", "1", "2"), block_of("b", "2")]), "found 2 twice")


class Mortal:
    """A worker in place of `LabelScans`, which a scan named poison kills."""

    def __init__(self, labelling: Labelling) -> None:
        self.schema = results_schema(labelling.taxonomy)

    def measure(self, scans: pa.Table) -> dict[str, object]:
        return {"drive": scans["drive"][0].as_py(), "assumed": "", "estimates": "null"}

    def __call__(self, batch: pa.Table) -> pa.Table:
        names = batch["name"].to_pylist()
        if "poison" in names:
            os.kill(os.getpid(), signal.SIGKILL)
        values = {"points": 1, "uncertain": 0.0, "is_fatal": "full" in names}
        error = "/full/disk: No space left" if "full" in names else None
        rows = [{"scan": name, "error": error, **values} for name in names]
        return pa.Table.from_pylist(rows, self.schema)


@pytest.fixture
def run_of(
    ray_here: None, fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[FleetRun]:
    """A run of one mortal worker, whose tables are not run again if it ends."""
    ray.cloudpickle.register_pickle_by_value(sys.modules[__name__])
    monkeypatch.setattr(workers_module, "LabelScans", Mortal)
    monkeypatch.setattr(workers_module, "RETRIES", 0)
    labelling = labelling_of(fleet, str(tmp_path))
    with closing(Workers(labelling, 1)) as workers:
        yield FleetRun(labelling, Results(Place.of(str(tmp_path)), {}), workers)


def label(run: FleetRun, *blocks: pa.Table) -> None:
    remaining = run.plan(blocks)
    run.measure()
    run.label(remaining)


def test_a_scan_that_ends_its_workers_is_a_broken_one(run_of: FleetRun, tmp_path: Path) -> None:
    label(run_of, block_of("a", "1", "poison", "2"), block_of("b", "3"))
    run_of.results.flush()
    rows = pa.parquet.read_table(sorted(tmp_path.glob("results/part-*"))).to_pylist()
    errors = {row["scan"]: row["error"] for row in rows}
    assert len(rows) == len(errors) == 4
    assert [name for name, error in errors.items() if error] == ["poison"]
    with pytest.raises(SomeBroken, match="3 of 4 scans segmented, 1 broken"):
        run_of.finish()


def test_a_full_disk_ends_the_run_and_keeps_what_is_done(run_of: FleetRun) -> None:
    with pytest.raises(OSError, match="No space left") as caught:
        label(run_of, block_of("a", "full"))
    assert caught.value.filename == "/full/disk"


class Reluctant(Mortal):
    """A worker that never starts."""

    def __init__(self, labelling: Labelling) -> None:
        raise InputError("expected a library on this machine, found none; install it")


def test_workers_that_cannot_start_are_one_line(
    ray_here: None, fleet: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ray.cloudpickle.register_pickle_by_value(sys.modules[__name__])
    monkeypatch.setattr(workers_module, "LabelScans", Reluctant)
    with closing(Workers(labelling_of(fleet, "x"), 1)) as workers:
        fails(lambda: list(workers.run("measure", [block_of("a", "1")])), "install it")
