"""A small fleet: two drives of simulated scans, and what `predict` makes of them."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

from amvnet.weights.file import save

from fixtures.worlds import fresh_weights, street, succeed

# They are not among the packages of `make test`.
HAS_PACKAGES = all(find_spec(name) for name in ("pyarrow", "moto", "boto3"))
collect_ignore_glob = [] if HAS_PACKAGES else ["test_*.py"]

DRIVES = 5
SCANS = 4  # of each drive


@pytest.fixture(scope="session")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with weights, `scans/DRIVE/NUMBER.bin`, and the labels by `predict`."""
    root = tmp_path_factory.mktemp("fleet")
    save(fresh_weights(), root / "w.safetensors")
    for drive in range(DRIVES):
        folder = root / f"scans/drive{drive}"
        folder.mkdir(parents=True)
        for index in range(SCANS):
            points, _ = street(SCANS * drive + index)
            points[:, 2] -= 0.2 * drive  # each sensor at another height
            points.tofile(folder / f"{index:06d}.bin")
    succeed(f"predict '{root}/scans/*/*.bin' --weights {root}/w.safetensors --out {root}/labels")
    return root


@pytest.fixture(scope="session")
def labels(fleet: Path) -> dict[str, bytes]:
    """The label files by `predict`, by their names."""
    paths = (fleet / "labels").rglob("*.label")
    return {path.relative_to(fleet / "labels").as_posix(): path.read_bytes() for path in paths}


@pytest.fixture(scope="session")
def bucket(fleet: Path) -> Iterator[object]:
    """A bucket of an S3 server with the scans."""
    from fixtures.s3_server import s3_server

    with s3_server() as bucket:
        bucket.upload(fleet / "scans", "scans")
        yield bucket
