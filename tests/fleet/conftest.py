"""A small fleet: two drives of simulated scans, and what `predict` makes of them."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from amvnet.weights.file import save

from fixtures.commands import succeed
from fixtures.tiny import fresh_weights, street

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
    paths = (fleet / "labels").rglob("*.label")
    return {path.relative_to(fleet / "labels").as_posix(): path.read_bytes() for path in paths}


@pytest.fixture(scope="session")
def bucket(fleet: Path) -> Iterator[object]:
    from fixtures.s3_server import s3_server

    with s3_server() as bucket:
        bucket.upload(fleet / "scans", "scans")
        yield bucket


class Refusing(BaseHTTPRequestHandler):
    """Answers as S3 does to those who have no credentials."""

    def do_GET(self) -> None:
        body = b"<Error><Code>AccessDenied</Code><Message>Access Denied</Message></Error>"
        self.send_response(403)
        self.send_header("Content-Type", "application/xml")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    do_HEAD = do_PUT = do_POST = do_GET

    def log_message(self, *_: Any) -> None:
        pass


@pytest.fixture
def locked_bucket(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[str]:
    """The URL of a bucket for which there are no credentials."""
    server = HTTPServer(("127.0.0.1", 0), Refusing)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_PROFILE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{server.server_port}")
    monkeypatch.setenv("HOME", str(tmp_path))  # without a file of credentials
    yield f"s3://locked-{server.server_port}"  # filesystems of buckets are kept
    server.shutdown()
    server.server_close()
