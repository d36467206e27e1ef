"""Write one self-contained HTML page that shows scans in 3D; the page fetches nothing."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import math
import re
import tempfile
import webbrowser
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amvnet.data.taxonomy import SEMANTICKITTI, UNCERTAIN_COLOR, WRONG_COLOR, Taxonomy, class_colors
from amvnet.evaluation.metrics import OVERALL, Evaluation
from amvnet.files import Signature, atomic_write, check_outputs, unfinished
from amvnet.inference.segmentation import Segmentation
from amvnet.models.methods import METHODS, title_of
from amvnet.scan import AnyArray, Scan
from amvnet.sensors.reading import checked_scan
from amvnet.viewing.shown_scans import CORRECT, UNSCORED, ShownScan, short_name, shown_scan

# Largest number of points of a scan that the page shows. The page shows every second or third point
# of a larger scan, so that phones keep up.
MAX_POINTS = 400_000
# The largest coordinate that the page shows, metres. Farther points are left out, so that rounding
# to int16 moves a point by 0.8 cm at most.
REACH = 500.0
LEVELS = 32_767  # the largest int16
PAGE = Signature("a page of view", rb'<!doctype html>.*<meta name="generator" content="AMVNet">')
RAMP_STOPS = 17  # the number of colours between which the page interpolates a ramp
# Matplotlib's colour map for each ramp, and the part of the map that is used, in [0, 1].
RAMPS = {"height": ("turbo", 0.06, 0.94), "intensity": ("inferno", 0.16, 1.0)}
# The colours from no disagreement to full disagreement of the networks, RGB in 0..255.
UNCERTAINTY_RAMP = (CORRECT, (122, 104, 132), (190, 124, 158), UNCERTAIN_COLOR, (255, 205, 220))
# The order counts: later scripts use what earlier scripts define.
SCRIPTS = (
    "scans.js",
    "camera.js",
    "shaders.js",
    "draw.js",
    "look.js",
    "panel.js",
    "point.js",
    "measure.js",
    "edit.js",
    "pointers.js",
    "page.js",
)


@dataclass(frozen=True)
class Packed:
    """One scan, packed for the page.

    Attributes:
        about: the scan's name, number of points and other properties, for the page's JSON.
        planes: the values of the points as `pack` lays them out, deflated and in base64.
        present: the train ids that appear in the ground truth and the labels.
        heights: the heights of the lowest points, of the ground and of the highest points, metres.
        intensity: the largest intensity except for outliers, in [0, 1].
    """

    about: dict[str, Any]
    planes: str
    present: set[int]
    heights: tuple[float, float, float]
    intensity: float


def show(
    shown: Segmentation | Scan | AnyArray, path: Path | str | None = None, open_browser: bool = True
) -> Path:
    """Write a page that shows a scan in 3D, open it, and return its path.

    Of a result, the page shows the labels, the labels of each network, the uncertain points and, if
    the scan has a ground truth, the errors.

    Args:
        shown: the result of a `Segmenter`; or a scan or an array of points, as a `Segmenter` takes
            it.
        path: the file, which may replace an earlier page and gets the ending `.html` if it has
            none; by default a file in a temporary folder.
        open_browser: also open the page.

    Raises:
        InputError: if no point is valid, or the file cannot be written or holds something other
            than a page.
    """
    if isinstance(shown, Segmentation):
        origin = shown.require_origin()
        scan, taxonomy, source = origin.scan, origin.taxonomy, origin.path
        content = shown_scan(shown, origin)
    else:
        scan, taxonomy, source = checked_scan(shown), SEMANTICKITTI, None
        content = ShownScan(short_name(scan), scan.points, scan.valid, truth=scan.labels)

    page_path = None if path is None else page_name(path)
    if page_path is not None:
        check_outputs({page_path: PAGE}, [source], overwrite=True)
    with place_for_page(page_path) as page:
        write_page(page, [content], taxonomy, short_name(scan))
    if open_browser:
        open_page(page)

    return page


def page_name(path: Path | str) -> Path:
    """Return the path of a page, with the ending `.html` if it has none of a page."""
    path = Path(path)
    if path.name in ("", "..") or path.suffix.lower() in (".html", ".htm"):
        return path  # such as "." or "/", which `check_outputs` refuses
    return path.with_name(f"{path.name}.html")


@contextmanager
def place_for_page(path: Path | None) -> Iterator[Path]:
    """Yield the path, or a path in a new temporary folder, which stays if the page is written."""
    if path is not None:
        yield path
        return

    folder = Path(tempfile.mkdtemp(prefix="amvnet-"))
    unfinished.add(folder)
    try:
        yield folder / "scan.html"
    finally:
        unfinished.discard(folder)
        with suppress(OSError):  # the page is in the folder
            folder.rmdir()


def open_page(path: Path) -> None:
    """Open a page in the browser of this machine, if it has one."""
    webbrowser.open(path.resolve().as_uri())


def write_page(
    path: Path | str, scans: Iterable[ShownScan], taxonomy: Taxonomy, title: str
) -> Evaluation:
    """Write one self-contained page with some scans in order; the file appears whole or not at all.

    Returns:
        The evaluation of all labels that have a ground truth; the page shows it as a table.
    """
    packed = []
    evaluation = Evaluation(taxonomy)
    for shown in scans:
        packed.append(pack(shown))
        if shown.truth is not None and shown.labels:
            evaluation.add(shown.points, shown.truth, shown.labels, shown.uncertain)

    page = assemble(packed, taxonomy, title, evaluation)
    with atomic_write(path) as part:
        part.write_bytes(page.encode("utf-8", "replace"))  # file names may not be Unicode
    return evaluation


def pack(shown: ShownScan) -> Packed:
    """Quantise one scan: positions to int16 within the scan's extent, all other values to bytes.

    The planes begin with x, y and z. Each of them has the low bytes and then the high bytes of the
    differences between consecutive points. The planes that `about["planes"]` names follow, with one
    byte per point.
    """
    in_reach = shown.valid & (np.abs(shown.points[:, :3]) <= REACH).all(axis=1)
    indices = np.flatnonzero(in_reach)
    left_out = len(shown.points) - len(indices)
    stride = max(1, math.ceil(len(indices) / MAX_POINTS))
    indices = indices[::stride]

    xyz = shown.points[indices, :3].astype(np.float64)
    center, step = _quantisation(xyz)
    steps = np.round((xyz - center) / step).astype(np.int16)

    data = bytearray()
    for axis in steps.T:
        data += _differences(axis)
    planes = {}
    present: set[int] = set()
    for name, values in _byte_planes(shown).items():
        planes[name] = values[indices]
        data += planes[name].tobytes()
        if name == "truth" or name in shown.labels:
            present.update(np.unique(planes[name]).tolist())

    notes = []
    if left_out:
        notes.append(f"{left_out:,} without a position, of the car itself or beyond {REACH:g} m")
    if stride > 1:
        notes.append(f"one in {stride} of the scan")

    about = {
        "name": shown.name,
        "count": len(indices),
        "note": "; ".join(notes),
        "corrected": shown.corrected,
        "origin": shown.origin,
        "center": center.tolist(),
        "step": step.tolist(),
        "planes": list(planes),
    }
    is_empty = not len(indices)
    low, ground, high = (0, 0, 1) if is_empty else np.percentile(xyz[:, 2], (1, 10, 99)).tolist()

    return Packed(
        about=about,
        planes=base64.b64encode(zlib.compress(data, 9)).decode("ascii"),
        present=present,
        heights=(low, ground, high),
        intensity=1.0 if is_empty else float(np.percentile(planes["intensity"], 98)) / 255,
    )


def assemble(packed: list[Packed], taxonomy: Taxonomy, title: str, evaluation: Evaluation) -> str:
    """Return the text of the page; names of files in it cannot act as HTML or script."""
    scans = []
    for index, scan in enumerate(packed):
        scans.append(f'<script type="text/plain" id="scan-{index}">{scan.planes}</script>')
    about = _about(packed, taxonomy, title) | {"table": _table(evaluation)}
    return fill_page(title, about, "\n".join(scans))


def fill_page(
    title: str, about: Mapping[str, Any], scans: str = "", replaced: Mapping[str, str] | None = None
) -> str:
    """Return the text of a page with the viewer's markup, style and scripts, or replaced ones."""
    scripts = {name: _source(name) for name in SCRIPTS} | dict(replaced or {})
    style = _source("page.css")
    script = "\n".join(scripts.values())
    policy = (
        f"default-src 'none'; style-src '{_hash(style)}'; script-src '{_hash(script)}'; "
        "img-src data:; base-uri 'none'; form-action 'none'"
    )
    parts = {
        "POLICY": policy,
        "TITLE": html.escape(title),
        "STYLE": style,
        "SCRIPT": script,
        # JSON that cannot close the HTML element that contains it.
        "ABOUT": json.dumps(about, separators=(",", ":")).replace("<", "\\u003c"),
        "SCANS": scans,
    }
    # In one pass: an @@NAME@@ within a part stays unchanged.
    return re.sub("@@([A-Z]+)@@", lambda match: parts[match[1]], _source("page.html"))


def _about(packed: list[Packed], taxonomy: Taxonomy, title: str) -> dict[str, Any]:
    """Return the values that the page's scripts need for all scans, for the page's JSON."""
    present: set[int] = set()
    planes: set[str] = set()
    for scan in packed:
        present |= scan.present
        planes |= set(scan.about["planes"])

    sources = []
    for name in ("truth", *METHODS, "labels"):
        if name in planes:
            words = title_of(name)
            sources.append({"key": name, "title": words[:1].upper() + words[1:]})

    lows, grounds, highs = zip(*(scan.heights for scan in packed), strict=True)
    brightest = max(scan.intensity for scan in packed)

    return {
        "title": title,
        "classes": ["unlabelled", *taxonomy.classes],
        "colors": class_colors(taxonomy),
        "raw": taxonomy.train_to_raw,
        "present": sorted(present),
        "sources": sources,
        "scans": [scan.about for scan in packed],
        "ranges": {
            "uncertainty": (0, 1),
            "height": (min(lows), max(highs)),
            "intensity": (0, brightest),
        },
        "ground": float(np.median(grounds)),
        **drawing(),
    }


def drawing() -> dict[str, Any]:
    """Return the colours that the page's scripts use for any scan, for the page's JSON."""
    return {
        "marks": {"correct": CORRECT, "wrong": WRONG_COLOR, "unscored": UNSCORED},
        "ramps": {
            "uncertainty": UNCERTAINTY_RAMP,
            "height": _ramp(*RAMPS["height"]),
            "intensity": _ramp(*RAMPS["intensity"]),
        },
    }


def _table(evaluation: Evaluation) -> dict[str, Any] | None:
    if not evaluation.matrices:
        return None

    report = evaluation.report("")
    figures = list(report["methods"].values())
    rows = []
    for index, name in enumerate(evaluation.taxonomy.classes):
        rows.append({"class": index + 1, "values": [_percent(f["iou"][name]) for f in figures]})
    totals = []
    for key, words in OVERALL.items():
        totals.append({"name": words, "values": [_percent(f[key]) for f in figures]})

    return {
        "methods": [title_of(name) for name in report["methods"]],
        "rows": rows,
        "totals": totals,
        "scans": report["scans"],
        "uncertain": _percent(report["uncertain_fraction"]),
    }


def _percent(share: float | None) -> float | None:
    return None if share is None else round(100 * share, 1)


def _byte_planes(shown: ShownScan) -> dict[str, np.ndarray]:
    """Return all values of the points except their positions, (N,) uint8 each, by name."""
    planes = {"intensity": _to_bytes(np.nan_to_num(shown.points[:, 3]))}

    if shown.truth is not None:
        planes["truth"] = shown.truth.astype(np.uint8)
    for method, ids in shown.labels.items():
        planes[method] = ids.astype(np.uint8)
    for method, values in shown.probabilities.items():
        planes[f"{method}-probability"] = _to_percent(values)
    if shown.second is not None and shown.second_probability is not None:
        planes["second"] = shown.second.astype(np.uint8)
        planes["second-probability"] = _to_percent(shown.second_probability)
    if shown.uncertain is not None and shown.disagreement is not None:
        planes["uncertain"] = shown.uncertain.astype(np.uint8)
        planes["disagreement"] = _to_bytes(shown.disagreement)

    return planes


def _to_bytes(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    scaled: NDArray[np.uint8] = np.round(np.clip(values, 0, 1) * 255).astype(np.uint8)
    return scaled


def _to_percent(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Map values in [0, 1] to 0..100, which deflate better than 0..255."""
    scaled: NDArray[np.uint8] = np.round(np.clip(values, 0, 1) * 100).astype(np.uint8)
    return scaled


def _quantisation(xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the middle of (N, 3) points and the length of an int16 step, both (3,) in metres."""
    if not len(xyz):
        return np.zeros(3), np.ones(3)

    low = xyz.min(axis=0)
    high = xyz.max(axis=0)
    return (low + high) / 2, np.maximum((high - low) / 2, 1e-3) / LEVELS


def _differences(steps: np.ndarray) -> bytes:
    """Return the differences of consecutive values, (N,) int16: all low bytes, then all high bytes.

    The first difference is the first value. Differences are modulo 2^16. They deflate to half the
    size of the values.
    """
    changes = np.diff(steps.view(np.uint16), prepend=np.uint16(0)).astype("<u2")
    return changes.view(np.uint8).reshape(-1, 2).T.tobytes()


def _ramp(name: str, start: float, end: float) -> list[list[int]]:
    """Return `RAMP_STOPS` RGB colours in 0..255 from a part of one of Matplotlib's colour maps."""
    from matplotlib import colormaps

    colors = colormaps[name](np.linspace(start, end, RAMP_STOPS))[:, :3]
    ramp: list[list[int]] = (colors * 255).round().astype(int).tolist()
    return ramp


def _source(name: str) -> str:
    path = resources.files("amvnet.viewing") / "page_assets" / name
    return path.read_text(encoding="utf-8")


def _hash(text: str) -> str:
    """Return the hash with which a content security policy allows this text and no other."""
    digest = hashlib.sha256(text.encode()).digest()
    return "sha256-" + base64.b64encode(digest).decode()
