"""The page of web/ labels scans in Chromium as `onnx_runner.py` does."""

from __future__ import annotations

import gzip
import json
import os
import re
import shutil
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest

from amvnet.data.formats.detect import ending_of
from amvnet.data.formats.registry import read_file
from amvnet.data.formats.rows import UNKNOWN
from amvnet.data.recordings import Recording, ScanFile
from amvnet.engines.export.onnx import export
from amvnet.onnx_runner import OnnxSegmenter
from amvnet.sensors.normalise import Normaliser
from amvnet.weights.file import load, save
from amvnet.weights.verdict import Verdict

from fixtures.browser_pages import CHROMIUM, FLAGS
from fixtures.commands import new_file
from fixtures.pages import load_script
from fixtures.scan_writers import write_pcd
from fixtures.sensors import LASERS, place
from fixtures.tiny import fresh_weights

ROOT = Path(__file__).parents[2]
DRIVER = ROOT / "tests" / "fixtures" / "web_page.mjs"
PLAYWRIGHT = ROOT / "web" / "node_modules" / "playwright-core"
NODE = shutil.which("node")
TIMEOUT = 1500  # seconds: a safety net; no outcome depends on it
MEGABYTE = 1_000_000
AGREEMENT = 0.999  # least share of the points with the labels of `onnx_runner.py`
HOSTILE = "<img src=x onerror=alert(1)>&amp;'\"%2e#?"  # a name that must stay a name
OWN = "mine"  # the folder of own weights beside the page
# With these headers, a browser may run threads.
ISOLATION = {
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Embedder-Policy": "require-corp",
}

# With these options, Chromium offers WebGPU without a GPU.
SOFTWARE_GPU = [
    "--enable-unsafe-webgpu",
    "--use-webgpu-adapter=swiftshader",
    "--enable-features=Vulkan",
]

MISSING = [
    what
    for what, is_missing in (
        ("Chromium", CHROMIUM is None),
        ("Node.js", NODE is None),
        ("web/node_modules (make docs)", not PLAYWRIGHT.is_dir()),
    )
    if is_missing
]
pytestmark = [
    pytest.mark.full,
    # CI has all of it.
    pytest.mark.skipif(
        bool(MISSING) and "CI" not in os.environ, reason=f"missing: {', '.join(MISSING)}"
    ),
    pytest.mark.timeout(TIMEOUT),
]


@dataclass
class Site:
    """A folder that is served, and the bytes of each request."""

    folder: Path
    url: str = ""
    sent: list[tuple[str, int]] = field(default_factory=list)


@contextmanager
def served(folder: Path, headers: dict[str, str]) -> Iterator[Site]:
    """Serve a folder on this machine, with additional headers."""
    site = Site(folder)

    class Handler(SimpleHTTPRequestHandler):
        def end_headers(self) -> None:
            for name, value in headers.items():
                self.send_header(name, value)
            super().end_headers()

        def copyfile(self, source: Any, outputfile: Any) -> None:
            data = source.read()
            site.sent.append((self.path, len(data)))
            outputfile.write(data)

        def log_message(self, *_: Any) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=str(folder)))
    site.url = f"http://127.0.0.1:{server.server_port}/try/"
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield site
    finally:
        server.shutdown()
        server.server_close()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, graphs_converted_once: None) -> Path:
    """Build the page with tiny weights beside the built-in ones; return the folder around it."""
    site = tmp_path_factory.mktemp("site")
    load_script("web/build.py").build(site / "try")

    # As docs/deployment.md says.
    save(fresh_weights(), own_weights(site))
    export(own_weights(site), site / "try" / OWN)
    models = site / "try" / "models.json"
    listed = [*json.loads(models.read_text()), {"folder": OWN, "title": "Our classes"}]
    models.write_text(json.dumps(listed))
    return site


def own_weights(site: Path) -> Path:
    return site / f"{OWN}.safetensors"


def drive(
    site: Site, cases: list[dict[str, Any]], downloads: Path, on_gpu: bool = False
) -> dict[str, Any]:
    """Open the page in Chromium and label scans; return the report of the driver."""
    flags = [flag for flag in FLAGS if "=" not in flag or "gl" in flag]
    if on_gpu:
        flags = [flag for flag in flags if flag != "--disable-gpu"] + SOFTWARE_GPU
    job = {
        "playwright": str(PLAYWRIGHT),
        "chromium": CHROMIUM,
        "flags": flags,
        "url": f"{site.url}index.html{'?device=webgpu' if on_gpu else ''}",
        "cases": cases,
    }
    command = [str(NODE), str(DRIVER), str(downloads), json.dumps(job)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT)
    assert done.returncode == 0, done.stderr
    return dict(json.loads(done.stdout))


def scan_files(folder: Path) -> dict[str, Path]:
    """Write a scan as of KITTI, one as of nuScenes, one of PCL, a small one and a broken file."""
    points, _ = place(np.linspace(-23.9, 3, 64), 2.2, steps=500)
    points[::40, :3] = 0  # lost returns
    kitti = new_file(folder / "kitti.bin", points.astype(np.float32).tobytes())

    points, laser = place(LASERS["hdl32e"], 1.84, steps=1000)
    nuscenes = folder / "nuscenes.pcd.bin"
    table = np.column_stack([points * [1, 1, 1, 255], laser])
    nuscenes.write_bytes(table.astype(np.float32).tobytes())

    points, _ = place(LASERS["os1-64"], 1.9, steps=500)
    pcd = write_pcd(folder / "cloud.pcd", points, "binary_compressed")
    points, _ = place(np.linspace(-23.9, 3, 16), 1.73, steps=250)
    own = new_file(folder / f"{HOSTILE}.bin", points.astype(np.float32).tobytes())
    broken = new_file(folder / f"{HOSTILE}.pcd", pcd.read_bytes()[:-500])
    return {"kitti": kitti, "nuscenes": nuscenes, "pcd": pcd, "own": own, "broken": broken}


@dataclass(frozen=True)
class Session:
    """What one browser did with all scans.

    Attributes:
        report: of the driver.
        results: of the driver, by the name of the case.
        files: the scans, by the name of the case.
        site: the folder that was served.
    """

    report: dict[str, Any]
    results: dict[str, dict[str, Any]]
    files: dict[str, Path]
    site: Site


@pytest.fixture(scope="module")
def session(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Session:
    """Label all scans in a browser that may use threads."""
    scans = tmp_path_factory.mktemp("scans")
    files = {"sample": folder / "try" / "street.bin", **scan_files(scans)}
    cases = [
        {"model": 0, "kinds": ["label", "npy"]},
        {"file": str(files["kitti"]), "model": 0},
        {"file": str(files["nuscenes"]), "model": 0},  # whose lasers only model 1 knows
        {"file": str(files["pcd"]), "model": 0},
        {"file": str(files["own"]), "model": 3},
        {"file": str(files["broken"]), "model": 0},
        {"drop": ["a.bin", "b.bin"], "model": 0},
        {"file": str(files["kitti"]), "model": 0, "isSlow": True},
    ]
    with served(folder, ISOLATION) as site:
        report = drive(site, cases, scans)
    results = dict(zip([*files, "several", "slow"], report["results"], strict=True))
    return Session(report, results, files, site)


@pytest.fixture(scope="module")
def plain(
    folder: Path, session: Session, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Any]:
    """Label a scan in a browser that may not use threads, and then with two other weights."""
    cases: list[dict[str, Any]] = [
        {"file": str(session.files["nuscenes"]), "model": 1},
        {"choices": [0, 3]},
    ]
    with served(folder, {}) as site:
        return drive(site, cases, tmp_path_factory.mktemp("plain"))


def reference(path: Path, weights: str | Path, graphs: Path) -> tuple[np.ndarray, Verdict]:
    """Return raw ids of a scan by `onnx_runner.py`, normalised as in `predict`, and the verdict."""
    loaded = load(weights)
    normaliser = Normaliser(loaded.expects)
    cloud = read_file(path, ending_of(path), UNKNOWN)
    recording = Recording("scans")
    recording.scans.append(ScanFile("scan", recording, path, read=lambda: cloud))
    scan = normaliser(recording).to_scan(cloud)

    result = OnnxSegmenter(graphs)(scan)
    verdict = Verdict(result.uncertain[scan.valid].mean(), loaded.usual_uncertain)
    return loaded.taxonomy.to_raw(result.labels), verdict


WEIGHTS = {
    "sample": "sim-hdl64e",
    "kitti": "sim-hdl64e",
    "nuscenes": "sim-hdl32e",
    "pcd": "sim-any",
}


@pytest.mark.parametrize("name", WEIGHTS)
def test_a_scan_gets_the_labels_of_the_onnx_runner(
    name: str, session: Session, folder: Path, tmp_path: Path
) -> None:
    weights = WEIGHTS[name]
    graphs = shutil.copytree(folder / "try" / weights, tmp_path / weights)
    for graph in graphs.glob("*.onnx"):
        graph.write_bytes(gzip.decompress(graph.read_bytes()))  # the page unpacks them itself
    expected, verdict = reference(session.files[name], weights, graphs)
    check_labels(session.results[name], expected)
    check_verdict(session.results[name], verdict)
    assert len(np.unique(expected)) > 3


def check_verdict(result: dict[str, Any], verdict: Verdict) -> None:
    line = result["problem"] if verdict.is_doubtful else result["line"]
    share = re.search(r"([0-9.]+)% of the points are uncertain \(usual: ", line)
    assert share is not None, line
    assert float(share[1]) == pytest.approx(100 * verdict.share, abs=0.5)
    assert ("do not rely" in result["problem"]) == verdict.is_doubtful


def check_labels(result: dict[str, Any], expected: np.ndarray) -> None:
    assert result["state"] == "labelled", result["problem"]
    ids = np.fromfile(result["label"], np.uint32)
    assert len(ids) == len(expected)
    assert (ids == expected).mean() >= AGREEMENT


def test_own_weights_by_the_page_label_as_the_onnx_runner(session: Session, folder: Path) -> None:
    expected, _ = reference(session.files["own"], own_weights(folder), folder / "try" / OWN)
    check_labels(session.results["own"], expected)


def test_both_downloads_have_the_same_ids(session: Session) -> None:
    result = session.results["sample"]
    ids = np.load(result["npy"])
    assert ids.dtype == np.uint32
    assert np.array_equal(ids, np.fromfile(result["label"], np.uint32))
    assert result["names"] == ["street.label", "street.npy"]


def test_the_viewer_draws_every_point_with_its_label(session: Session) -> None:
    result = session.results["sample"]
    assert result["sources"] == ["RV", "BEV", "Ensemble", "AMVNet"]
    ids = np.fromfile(result["label"], np.uint32)
    counts = np.unique(ids[ids > 0], return_counts=True)[1]
    assert sorted(filter(None, result["drawn"])) == sorted(counts.tolist())
    assert set(np.flatnonzero(result["drawn"])) <= set(result["present"])
    assert 0 not in result["present"]  # every drawn point has a class


def test_a_broken_file_gives_its_line(session: Session) -> None:
    result = session.results["broken"]
    assert result["state"] == "failed"
    assert result["problem"].startswith(f"{HOSTILE}.pcd: expected at least ")
    assert result["problem"].endswith("the file is truncated, copy it again")
    assert result["line"] == ""


def test_hostile_names_of_files_stay_names(session: Session) -> None:
    assert session.results["own"]["assumed"].startswith(f"{HOSTILE}.bin: assumed")
    assert session.report["console"] == []  # an image that is missing would be an error there


def test_only_one_of_several_dropped_files_can_be_labelled(session: Session) -> None:
    result = session.results["several"]
    assert result["state"] == "failed"
    assert result["problem"] == "expected one scan, found 2 files; drop one of them"


def test_steps_have_times_and_the_line_says_what_was_assumed(session: Session) -> None:
    result = session.results["kitti"]
    titles = [title for title, _ in result["steps"]]
    assert all(time.endswith(" s") for _, time in result["steps"])
    assert titles[:2] == ["read", "normalise"]
    assert {"range-view network", "bird's-eye-view network", "point head", "merge"} <= set(titles)
    assert "moved by" in result["assumed"]


def test_the_page_answers_while_it_labels_and_draws_slowly(session: Session) -> None:
    """It runs timers meanwhile. If it waited for a picture, it would run the next one after it."""
    result = session.results["slow"]
    assert result["state"] == "labelled"
    assert result["rounds"] > 20
    assert len(result["answers"]) == result["pictures"] + 3
    assert min(result["answers"]) > 1


def test_a_scan_is_drawn_once(session: Session) -> None:
    assert session.results["slow"]["pictures"] == 1


def test_nothing_leaves_the_folder_of_the_page(session: Session) -> None:
    requests = session.report["requests"]
    assert len(requests) > 30
    for url in requests:
        assert url.removeprefix("blob:").startswith(session.site.url) or url.startswith(
            f"blob:{session.site.url.removesuffix('try/')}"
        )


def test_the_console_has_no_errors_and_no_warnings(session: Session) -> None:
    assert session.report["console"] == []


def test_the_page_is_small(session: Session) -> None:
    sizes = dict(session.site.sent)
    paths = {urlsplit(url).path for url in session.report["first"]["requests"]}
    first = [sizes[path] for path in paths & sizes.keys()]
    assert len(first) > 20
    assert sum(first) < 3 * MEGABYTE
    files = (session.site.folder / "try").rglob("*")
    assert (
        sum(path.stat().st_size for path in files) < 60 * MEGABYTE
    )  # three sets of weights; a visit takes one
    assert session.report["memory"] < 1000 * MEGABYTE


def test_without_isolation_a_thread_labels_scans(plain: dict[str, Any], session: Session) -> None:
    result, _ = plain["results"]
    assert plain["isolated"] is False
    assert "one thread" in result["line"]
    check_labels(result, np.fromfile(session.results["nuscenes"]["label"], np.uint32))


def test_a_newer_request_ends_the_work_on_an_older_one(plain: dict[str, Any]) -> None:
    _, newer = plain["results"]
    assert newer["state"] == "labelled"
    folders = {Path(url).parent.name for url in plain["requests"] if url.endswith(".onnx")}
    assert folders == {WEIGHTS["nuscenes"], OWN}  # the older request needs the other weights


def test_webgpu_gives_the_labels_of_the_cpu(folder: Path, session: Session, tmp_path: Path) -> None:
    with served(folder, ISOLATION) as site:
        case = {"file": str(session.files["own"]), "model": 3}
        (result,) = drive(site, [case], tmp_path, on_gpu=True)["results"]
    if "on the GPU" not in result["line"]:
        pytest.skip("Chromium offers no WebGPU in software here")
    check_labels(result, np.fromfile(session.results["own"]["label"], np.uint32))
