"""Build the page that labels scans in the browser, `try/` of the site, when MkDocs builds it.

    python web/build.py FOLDER

builds the page alone. Its source is beside this module, which adds the networks of the built-in
weights, a sample scan, the viewer, and ONNX Runtime Web, which `npm ci --prefix web` fetches.
"""

from __future__ import annotations

import gzip
import hashlib
import json
import os
import shutil
import sys
from pathlib import Path
from typing import Any

from amvnet.data.taxonomy import DRAWN_COLORS, UNLABELLED_COLOR
from amvnet.engines.export.onnx import export
from amvnet.files import temporary_folder
from amvnet.viewing.page import drawing, fill_page
from lidarstreets import simulate

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "web"
PATTERNS = ("*.html", "*.css", "*.js", "*/*.js")  # the files of SOURCE; node_modules lies deeper
RUNTIME = SOURCE / "node_modules" / "onnxruntime-web" / "dist"
# ONNX Runtime Web for the CPU and, with jspi, for GPUs. Some hosts do not know that .mjs is
# JavaScript, so the page has these files as .js.
RUNTIME_SCRIPTS = (
    "ort.wasm.min.mjs",
    "ort-wasm-simd-threaded.mjs",
    "ort.jspi.min.mjs",
    "ort-wasm-simd-threaded.jspi.mjs",
)
# The page loads these compressed, because few hosts compress them; they shrink to a quarter.
RUNTIME_BINARIES = ("ort-wasm-simd-threaded.wasm", "ort-wasm-simd-threaded.jspi.wasm")
WITHOUT_RUNTIME = (
    f"{RUNTIME}: expected ONNX Runtime Web, found none: the page try/ is left out; install Node.js "
    "with npm, and run make docs again"
)

MODELS = (
    {"folder": "sim-hdl64e", "title": "HDL-64E, 19 classes", "sample": "street.bin"},
    {"folder": "sim-hdl32e", "title": "HDL-32E, 16 classes"},
    {"folder": "sim-any", "title": "any LiDAR, 19 classes"},
)
SAMPLE_SEED = 80
SAMPLE_STREET = 7  # the training has no such street

CACHE = ROOT / "build" / "try"  # keeps what takes a minute to make
MADE_BY = ("config", "engines", "models", "sensors", "weights")  # the packages that decide graphs


def on_files(files: Any, config: Any) -> None:
    """Name the page to MkDocs, so that other pages can link to it; MkDocs calls this first."""
    from mkdocs.structure.files import File  # here, because the page is also built without MkDocs

    index = str(SOURCE / "index.html")
    files.append(File.generated(config, "try/index.html", abs_src_path=index))


def on_post_build(config: Any) -> None:
    """Add the page to the site; MkDocs calls this at the end."""
    print("writing the page try/, which labels scans in the browser")
    out = Path(config.site_dir) / "try"
    shutil.rmtree(out)  # MkDocs has copied index.html
    if RUNTIME.is_dir():
        build(out)
    else:
        print(WITHOUT_RUNTIME)


def build(out: Path) -> None:
    """Write the page and all its files into a folder."""
    for pattern in PATTERNS:
        for path in SOURCE.glob(pattern):
            copy(path, out / path.relative_to(SOURCE))
    for name in RUNTIME_SCRIPTS:
        copy(RUNTIME / name, (out / "ort" / name).with_suffix(".js"))
    for name in RUNTIME_BINARIES:
        pack(RUNTIME / name, out / "ort" / f"{name}.gz")

    (out / "viewer.html").write_text(viewer(), encoding="utf-8")
    (out / "models.json").write_text(json.dumps(MODELS, indent=1) + "\n", encoding="utf-8")
    for model in MODELS:
        for path in graphs(model["folder"]).iterdir():
            write = pack if path.suffix == ".onnx" else copy
            write(path, out / model["folder"] / path.name)
    copy(sample(), out / MODELS[0]["sample"])


def copy(path: Path, to: Path) -> None:
    to.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(path, to)


def pack(path: Path, to: Path) -> None:
    """Write a file compressed by gzip, as the page's `unpacked` reads it."""
    to.parent.mkdir(parents=True, exist_ok=True)
    to.write_bytes(gzip.compress(path.read_bytes(), mtime=0))


def viewer() -> str:
    """Return the viewer's page, which takes the scan from the page around it."""
    colors = {"unlabelled": UNLABELLED_COLOR, "drawn": DRAWN_COLORS}
    script = (SOURCE / "viewer_data.js").read_text(encoding="utf-8")
    return fill_page("Scan", drawing() | colors, replaced={"scans.js": script})


def graphs(name: str) -> Path:
    """Return a folder with the exported graphs of built-in weights."""
    package = ROOT / "src" / "amvnet"
    sources = [package / "pretrained" / f"{name}.safetensors"]
    for part in MADE_BY:
        sources += sorted((package / part).rglob("*.py"))
    return cached(name, sources, lambda folder: export(name, folder))


def sample() -> Path:
    """Return the path of a simulated scan in KITTI's format."""

    def make(folder: Path) -> None:
        with temporary_folder() as city:
            simulate(city, scans=1, seed=SAMPLE_SEED, first_sequence=SAMPLE_STREET)
            copy(next(city.rglob("*.bin")), folder / "street.bin")

    sources = sorted((ROOT / "src" / "lidarstreets").rglob("*"))
    return cached("sample", [path for path in sources if path.is_file()], make) / "street.bin"


def cached(name: str, sources: list[Path], make: Any) -> Path:
    """Return a folder that `make` has filled; it is filled again if one of the sources changes."""
    digest = hashlib.sha256()
    for path in sources:
        if "__pycache__" not in path.parts:
            digest.update(path.read_bytes())

    folder = CACHE / f"{name}-{digest.hexdigest()[:16]}"
    if not folder.is_dir():
        print(f"making {name} of the page try/, and keeping it in {os.path.relpath(CACHE)}")
        with temporary_folder(CACHE) as unfinished:
            make(unfinished)
            try:
                unfinished.rename(folder)
            except OSError:
                if not folder.is_dir():  # else another build was faster
                    raise
        for old in set(CACHE.glob(f"{name}-*")) - {folder}:
            shutil.rmtree(old, ignore_errors=True)
    return folder


if __name__ == "__main__":
    if not RUNTIME.is_dir():
        sys.exit(WITHOUT_RUNTIME)
    build(Path(sys.argv[1]))
