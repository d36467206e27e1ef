"""One HTML page that shows scans in 3D: everything is in it, and nothing is fetched."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from amvnet.data.taxonomy import Taxonomy
from amvnet.files import atomic_write
from amvnet.models.methods import METHODS, title_of
from amvnet.viewing.frames import RIGHT, UNCERTAIN, UNLABELLED, UNSCORED, WRONG, Frame

MOST_POINTS = (
    400_000  # of one scan; of more, every second or third is drawn, so that a telephone can
)
REACH = 500.0  # metres along each axis; farther points are left out, so that positions stay within 1.6 cm of the truth
LEVELS = 32_767  # int16
STOPS = 17  # colours from which the page makes a ramp
RAMPS = {
    "height": ("turbo", 0.06, 0.94),
    "intensity": ("inferno", 0.16, 1.0),
}  # colour map, and the part that is used
DOUBT = (RIGHT, (128, 104, 92), (190, 110, 50), UNCERTAIN, (255, 190, 60))
SCRIPTS = ("scans", "camera", "shaders", "draw", "look", "panel", "point", "hands", "page")


@dataclass(frozen=True)
class Packed:
    """One scan as the page carries it: what JSON says of it, and its planes, deflated and in base64."""

    about: dict[str, Any]
    planes: str
    present: frozenset[int]  # ids of the classes in it
    height: tuple[float, float]  # most points are between these, metres
    intensity: float  # most points are below
    ground: float


def write_page(path: Path | str, frames: Iterable[Frame], taxonomy: Taxonomy, title: str) -> Path:
    """Write scans as one self-contained page; it appears whole or not at all.

    Args:
        path: the HTML file.
        frames: the scans, in order of the page's slider.
        taxonomy: names and colours of the classes.
        title: of the page.

    Raises:
        InputError: where the file cannot be written.
    """
    packed = [pack(frame) for frame in frames]
    page = assemble(packed, taxonomy, title)
    with atomic_write(path) as part:
        part.write_bytes(page.encode("utf-8", "replace"))  # names of files need not be Unicode
    return Path(path)


def pack(frame: Frame) -> Packed:
    """Quantise one scan: positions to int16 within the scan's extent, all else to bytes.

    The planes are the low and the high bytes of the differences of x, of y and of z from point to point, and then what
    `about["planes"]` names, a byte for each point.
    """
    kept = frame.valid & (np.abs(frame.points[:, :3]) <= REACH).all(axis=1)
    every = -(-int(kept.sum()) // MOST_POINTS) or 1
    chosen = np.flatnonzero(kept)[::every]
    xyz = frame.points[chosen, :3].astype(np.float64)
    center, step = _extent(xyz)
    steps = np.round((xyz - center) / step).astype(np.int16)
    values = {name: values[chosen] for name, values in _values(frame).items()}
    data = b"".join(
        [*(_differences(axis) for axis in steps.T), *(plane.tobytes() for plane in values.values())]
    )
    low, high = (float(v) for v in np.percentile(xyz[:, 2], (1, 99))) if len(xyz) else (0.0, 1.0)
    about = {
        "name": frame.name,
        "count": len(chosen),
        "note": _note(len(frame.points) - int(kept.sum()), every),
        "center": center.tolist(),
        "step": step.tolist(),
        "planes": list(values),
    }
    ids = [values[name] for name in (*frame.labels, "truth") if name in values]
    return Packed(
        about,
        base64.b64encode(zlib.compress(data, 9)).decode("ascii"),
        frozenset(int(i) for plane in ids for i in np.unique(plane)),
        (low, high),
        float(np.percentile(values["intensity"], 98)) / 255 if len(chosen) else 1.0,
        float(np.percentile(xyz[:, 2], 10)) if len(xyz) else 0.0,
    )


def assemble(packed: list[Packed], taxonomy: Taxonomy, title: str) -> str:
    """The text of the page. What the user's files are called goes in as JSON, or escaped."""
    style, script = _source("page.css"), "\n".join(_source(f"{name}.js") for name in SCRIPTS)
    scans = [
        f'<script type="text/plain" id="scan-{place}">{scan.planes}</script>'
        for place, scan in enumerate(packed)
    ]
    return _fill(
        _source("page.html"),
        {
            "POLICY": f"default-src 'none'; style-src '{_hash(style)}'; script-src '{_hash(script)}'; img-src data:; "
            "base-uri 'none'; form-action 'none'",
            "TITLE": html.escape(title),
            "STYLE": style,
            "SCRIPT": script,
            "ABOUT": _json(_about(packed, taxonomy, title)),
            "SCANS": "\n".join(scans),
        },
    )


def _about(packed: list[Packed], taxonomy: Taxonomy, title: str) -> dict[str, Any]:
    planes = {plane for scan in packed for plane in scan.about["planes"]}
    sources = [name for name in ("truth", *METHODS, "labels") if name in planes]
    return {
        "title": title,
        "classes": ["unlabelled", *taxonomy.classes],
        "colors": [UNLABELLED, *taxonomy.colors[1:]],
        "marks": {"right": RIGHT, "wrong": WRONG, "unscored": UNSCORED},
        "present": sorted(set().union(*(scan.present for scan in packed))),
        "sources": [{"key": name, "title": _capital(title_of(name))} for name in sources],
        "scans": [scan.about for scan in packed],
        "ranges": {
            "uncertainty": (0, 1),
            "height": (
                min(scan.height[0] for scan in packed),
                max(scan.height[1] for scan in packed),
            ),
            "intensity": (0, max(scan.intensity for scan in packed)),
        },
        "ramps": {"uncertainty": DOUBT, **{name: _ramp(*part) for name, part in RAMPS.items()}},
        "ground": float(np.median([scan.ground for scan in packed])),
    }


def _values(frame: Frame) -> dict[str, np.ndarray]:
    """The planes of bytes beside the positions, (N,) uint8 each."""
    intensity = np.nan_to_num(frame.points[:, 3])
    planes = {"intensity": _byte(intensity)}
    if frame.truth is not None:
        planes["truth"] = frame.truth.astype(np.uint8)
    planes |= {name: ids.astype(np.uint8) for name, ids in frame.labels.items()}
    if frame.uncertain is not None and frame.disagreement is not None:
        planes |= {
            "uncertain": frame.uncertain.astype(np.uint8),
            "disagreement": _byte(frame.disagreement),
        }
    return planes


def _byte(values: np.ndarray) -> np.ndarray:
    """[0, 1] -> 0..255."""
    return np.round(np.clip(values, 0, 1) * 255).astype(np.uint8)


def _extent(xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(3,) middle of the points, and (3,) metres of one step of an int16 along each axis."""
    if not len(xyz):
        return np.zeros(3), np.ones(3)
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    return (low + high) / 2, np.maximum((high - low) / 2, 1e-3) / LEVELS


def _differences(steps: np.ndarray) -> bytes:
    """(N,) int16 -> low and then high bytes of the differences (modulo 2^16), which deflate to half the size."""
    changes = np.diff(steps.view(np.uint16), prepend=np.uint16(0)).astype("<u2")
    return changes.view(np.uint8).reshape(-1, 2).T.tobytes()


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _note(left_out: int, every: int) -> str:
    notes = [f"{left_out:,} without a place or beyond {REACH:g} m" if left_out else ""]
    notes.append(f"one in {every} of the scan" if every > 1 else "")
    return "; ".join(note for note in notes if note)


def _ramp(name: str, start: float, end: float) -> list[list[int]]:
    from matplotlib import colormaps

    return (
        (colormaps[name](np.linspace(start, end, STOPS))[:, :3] * 255).round().astype(int).tolist()
    )


def _source(name: str) -> str:
    return (resources.files("amvnet.viewing") / "page_assets" / name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    """What a content security policy allows to run: this text and no other."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _json(tree: Any) -> str:
    """JSON that cannot end the element it lies in."""
    return json.dumps(tree, separators=(",", ":")).replace("<", "\\u003c")


def _fill(template: str, parts: Mapping[str, str]) -> str:
    """Put each part in its place once; what looks like a place within a part stays as it is."""
    return re.sub("@@([A-Z]+)@@", lambda found: parts[found[1]], template)
