"""The pictures of the pages are small, and their legends have the colours of the classes."""

from __future__ import annotations

import re
from itertools import groupby
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from amvnet.data.taxonomy import SEMANTICKITTI, Color, class_colors

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
LARGEST = 4_000_000  # bytes
COLORS = class_colors(SEMANTICKITTI)
# The places of the swatches in the viewer's panel: their column, and their heights, pixels.
COLUMN = 35
HEIGHTS = range(8, 14)
DARK = 80  # more than any part of the panel's own colours
LOSS = 24  # the largest change of a colour by the compression of a moving picture
SHEET = 1088  # the height of the four pictures above the legend of the hard scan, pixels


def pixels(name: str) -> np.ndarray:
    """Return a picture, or its first frame, as (H, W, 3) in 0..255."""
    return np.asarray(Image.open(DOCS / name).convert("RGB")).astype(int)


def nearest(color: np.ndarray) -> tuple[int, int]:
    """Return the class whose colour is most similar, and the largest difference of a part."""
    differences = np.abs(np.array(COLORS) - color).max(axis=1)
    return int(differences.argmin()), int(differences.min())


def legend_of(name: str) -> list[tuple[int, int]]:
    """Return `nearest` of each swatch in the viewer's panel, from top to bottom."""
    picture = pixels(name)
    swatches = []
    row = 0
    for (_, is_bright), run in groupby(
        picture[:, COLUMN], key=lambda c: (nearest(c)[0], c.max() > DARK)
    ):
        height = len(list(run))
        middle = picture[row + height // 2]
        beside = [middle[COLUMN - 10].max(), middle[COLUMN + 10].max()]
        is_flat = np.ptp(middle[COLUMN - 4 : COLUMN + 5], axis=0).max() <= LOSS
        if is_bright and is_flat and height in HEIGHTS and max(beside) < DARK:
            swatches.append(nearest(middle[COLUMN]))
        row += height
    return swatches


@pytest.mark.parametrize(
    ("name", "difference"), [("page.png", 0), ("figures/map.png", 0), ("figures/viewer.webp", LOSS)]
)
def test_a_legend_in_the_viewer_has_the_colours_of_the_classes(name: str, difference: int) -> None:
    legend = legend_of(name)
    classes = [class_id for class_id, _ in legend]
    assert len(classes) >= 10
    assert classes == sorted(set(classes))
    assert max(error for _, error in legend) <= difference


def test_the_legend_of_the_hard_scan_has_the_colours_of_the_classes() -> None:
    legend = pixels("figures/hard_scan.png")[SHEET:]
    counts: dict[Color, int] = {}
    colors, numbers = np.unique(legend.reshape(-1, 3), axis=0, return_counts=True)
    for color, number in zip(colors, numbers, strict=True):
        counts[tuple(color.tolist())] = int(number)
    shown = [class_id for class_id, color in enumerate(COLORS) if counts.get(color, 0) > 200]
    assert len(shown) >= 10
    assert {SEMANTICKITTI.names.index(name) for name in ("car", "road", "building")} <= set(shown)


def test_pictures_are_small_and_shown() -> None:
    pages = [ROOT / "README.md", *DOCS.glob("*.md")]
    texts = "".join(page.read_text(encoding="utf-8") for page in pages)
    for path in [*DOCS.glob("*.png"), *(DOCS / "figures").iterdir()]:
        assert path.stat().st_size < LARGEST, path
        assert re.search(rf"\]\((docs/)?(figures/)?{re.escape(path.name)}\)", texts), path
