"""Draw one real scan in perspective, from behind and above the car: the picture of README.md.

    python docs/perspective.py pandaset/scans/001_00.bin pandaset/labels/001_00.npy [--out FILE.png]

The scan is from PandaSet by Hesai and Scale AI (CC BY 4.0). It has rows of float32: x forward, y
left and z up in metres, and intensity in [0, 1]. The labels are PandaSet's ids, one for each point.
The picture has four panels: official labels, AMVNet's labels, the uncertain points, and the wrong
labels. Points are drawn as discs whose size follows their distance, the nearest on top, at twice
the resolution of the picture.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

import amvnet
from amvnet.data import palette

PANEL = (1000, 560)  # the width and height of a panel, pixels
GAP = 8  # the distance between panels, pixels
OVERSAMPLE = 2  # the resolution of the drawing, relative to the picture
LEGEND = 56  # the height of a row of the legend, pixels
MAX_COLUMNS = 10  # largest number of classes in a row of the legend
LEAST = 120  # the least number of points of a class in the legend, over both upper panels

BACKGROUND = np.array([13, 16, 22], np.float32)
INK = (226, 230, 238)
PLAIN = (74, 82, 96)  # the colour of points that a panel does not mark

# The radius of a point for each metre from the sensor, metres; discs fill the gaps of a wall.
DISC = 0.004
SMALLEST = 0.028  # the least radius of a point, metres
FOG = 120.0  # the distance at which a colour has lost 63 % of its contrast, metres
REACH = 75.0  # the largest distance of points that are drawn, metres
DARKEST = 105.0  # the least luminance of class colours, which stand on a dark background


# The classes of the weights, by PandaSet's ids. Points of other ids, such as poles, are not
# compared.
OFFICIAL = {
    5: "vegetation",
    6: "terrain",  # "Ground"
    7: "road", 8: "road", 9: "road", 10: "road",  # road, and lines on it
    11: "sidewalk",
    13: "car", 14: "car",
    15: "truck", 16: "truck",
    18: "motorcycle",
    17: "other-vehicle", 19: "other-vehicle", 20: "other-vehicle", 23: "other-vehicle",
    26: "bicycle",
    30: "person", 31: "person",
    36: "traffic-sign", 38: "traffic-sign",
    41: "building",
}  # fmt: skip
# Classes of the weights that PandaSet does not tell from another class.
MERGED = {"parking": "road", "trunk": "vegetation"}


@dataclass(frozen=True)
class Camera:
    """A pinhole camera."""

    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    field_of_view: float
    """Degrees, horizontally."""

    def project(
        self, xyz: np.ndarray, width: int, height: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        """Return columns, rows and depths (metres) of (N, 3) points, and the focal length."""
        eye = np.array(self.eye)
        forward = np.array(self.target) - eye
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        up = np.cross(right, forward)

        focal = width / 2 / np.tan(np.radians(self.field_of_view) / 2)
        offset = xyz - eye
        depth = offset @ forward
        safe = np.maximum(depth, 0.1)
        column = width / 2 + focal * (offset @ right) / safe
        row = height / 2 - focal * (offset @ up) / safe
        return column, row, depth, focal


CAMERA = Camera(eye=(-20.5, -0.5, 9.5), target=(12.0, -0.5, -0.1), field_of_view=53)


def render(camera: Camera, xyz: np.ndarray, colors: np.ndarray, radius: np.ndarray) -> Image.Image:
    """Draw (N, 3) points as discs of a radius in metres, the nearest on top."""
    width = PANEL[0] * OVERSAMPLE
    height = PANEL[1] * OVERSAMPLE
    column, row, depth, focal = camera.project(xyz, width, height)
    pixels = np.clip(radius * focal / np.maximum(depth, 0.1), 0.75, 14)
    inside = (
        (depth > 0.5) & (column > -20) & (column < width + 20) & (row > -20) & (row < height + 20)
    )

    haze = np.exp(-np.maximum(depth - 15, 0) / FOG)[:, None]
    shaded = BACKGROUND + (colors - BACKGROUND) * haze
    image = np.tile(BACKGROUND, (height * width, 1))

    # The farthest first: what is written last is what is seen.
    order = np.flatnonzero(inside)
    order = order[np.argsort(-depth[order], kind="stable")]
    columns = column[order]
    rows = row[order]
    sizes = pixels[order]
    cells = []
    ranks = []
    reach = int(np.ceil(sizes.max()))
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            covered = np.flatnonzero(sizes**2 >= dx * dx + dy * dy)
            x = np.round(columns[covered]).astype(int) + dx
            y = np.round(rows[covered]).astype(int) + dy
            visible = (x >= 0) & (x < width) & (y >= 0) & (y < height)
            cells.append((y * width + x)[visible])
            ranks.append(covered[visible])

    nearest = np.full(height * width, -1)
    np.maximum.at(nearest, np.concatenate(cells), np.concatenate(ranks))
    hit = nearest >= 0
    image[hit] = shaded[order[nearest[hit]]]

    picture = Image.fromarray(image.reshape(height, width, 3).round().astype(np.uint8))
    return picture.resize(PANEL, Image.Resampling.LANCZOS)


def class_colors(taxonomy: Any, labels: np.ndarray) -> np.ndarray:
    """Return (N, 3) colours, the dark ones lifted so that they show on a dark background."""
    table = np.array(palette.class_colors(taxonomy), np.float32)
    weights = np.array([0.3, 0.59, 0.11], np.float32)
    luminance = table @ weights
    share = np.clip((DARKEST - luminance) / (255 - luminance), 0, 1)[:, None]
    table = table + (255 - table) * share * 0.75
    table[0] = PLAIN
    return table[labels]


def font(size: int) -> ImageFont.FreeTypeFont:
    """Return DejaVu Sans, which matplotlib brings."""
    import matplotlib

    return ImageFont.truetype(
        str(Path(matplotlib.get_data_path()) / "fonts/ttf/DejaVuSans.ttf"), size
    )


def draw(
    scan: amvnet.Scan, result: amvnet.Segmentation, taxonomy: Any, camera: Camera
) -> Image.Image:
    """Return the four panels with their titles and the legend."""
    xyz = scan.points[:, :3].astype(np.float64)
    distance = np.linalg.norm(xyz, axis=1)
    shown = scan.valid & (distance < REACH) & (distance > 2.6)
    xyz = xyz[shown]
    distance = distance[shown]
    labels = merged(taxonomy)[result.labels]
    truth = scan.labels
    assert truth is not None
    compared = scan.valid & (truth > 0)
    wrong = compared & (labels != truth)
    error = wrong.sum() / compared.sum()
    labels = labels[shown]
    truth = truth[shown]
    uncertain = result.uncertain[shown]
    wrong = wrong[shown]

    texture = (0.82 + 0.36 * scan.points[shown, 3:4]).astype(np.float32)
    radius = np.maximum(DISC * distance, SMALLEST)

    def panel(colors: np.ndarray, marked: np.ndarray | None = None) -> Image.Image:
        sizes = radius if marked is None else np.where(marked, 1.25 * radius, radius)
        return render(camera, xyz, colors, sizes)

    def by_class(labels: np.ndarray) -> Image.Image:
        return panel(np.clip(class_colors(taxonomy, labels) * texture, 0, 255))

    def highlight(marked: np.ndarray, color: tuple[int, int, int]) -> Image.Image:
        plain = np.array(PLAIN, np.float32) * texture
        return panel(np.where(marked[:, None], np.array(color, np.float32), plain), marked)

    share = result.uncertain[scan.valid].mean()
    panels = [
        ("Official labels (grey: not compared)", by_class(truth)),
        ("AMVNet", by_class(labels)),
        (
            f"Uncertain: the two networks disagree on {share:.0%} of the points",
            highlight(uncertain, palette.UNCERTAIN),
        ),
        (f"Wrong labels: {error:.0%} of the compared points", highlight(wrong, palette.WRONG)),
    ]

    width, height = PANEL
    counts = np.bincount(np.concatenate([truth, labels]), minlength=taxonomy.size + 1)
    present = np.flatnonzero(counts >= LEAST)
    size = (2 * width + GAP, 2 * height + GAP + LEGEND * legend_rows(present))
    sheet = Image.new("RGB", size, tuple(int(c) for c in BACKGROUND * 2))
    pen = ImageDraw.Draw(sheet)
    for place, (title, picture) in enumerate(panels):
        x, y = (place % 2) * (width + GAP), (place // 2) * (height + GAP)
        sheet.paste(picture, (x, y))
        pen.text((x + 22, y + 16), title, fill=INK, font=font(28))
    draw_legend(pen, taxonomy, present, 2 * height + GAP)
    return sheet


def draw_legend(pen: ImageDraw.ImageDraw, taxonomy: Any, present: np.ndarray, top: int) -> None:
    """Write the classes in rows below the panels."""
    ids = [int(class_id) for class_id in present if class_id > 0]
    columns = -(-len(ids) // legend_rows(present))
    step = (2 * PANEL[0] + GAP - 30) / columns
    for place, class_id in enumerate(ids):
        x = 22 + place % columns * step
        y = top + place // columns * LEGEND
        color = class_colors(taxonomy, np.array([class_id]))[0]
        pen.rounded_rectangle((x, y + 17, x + 22, y + 39), 5, fill=tuple(int(c) for c in color))
        pen.text((x + 32, y + 13), taxonomy.classes[class_id - 1], fill=INK, font=font(22))


def legend_rows(present: np.ndarray) -> int:
    """Return the number of rows of the legend, in which the names do not overlap."""
    return -(-int(np.count_nonzero(present)) // MAX_COLUMNS)


def reduced(sheet: Image.Image, taxonomy: Any) -> Image.Image:
    """Return the picture in 256 colours, which include the class colours; its file is a third."""
    sample = Image.new("RGB", (sheet.width, sheet.height + 20 * taxonomy.size))
    sample.paste(sheet, (0, 0))
    for place, color in enumerate(class_colors(taxonomy, np.arange(1, taxonomy.size + 1))):
        top = sheet.height + 20 * place
        sample.paste(tuple(int(c) for c in color), (0, top, sheet.width, top + 20))
    palette = sample.quantize(256, method=Image.Quantize.MEDIANCUT, kmeans=2)
    return sheet.quantize(palette=palette, dither=Image.Dither.NONE)


def merged(taxonomy: Any) -> np.ndarray:
    """Return the train id to draw for each train id of the weights."""
    table = np.arange(taxonomy.size + 1)
    for name, other in MERGED.items():
        table[taxonomy.names.index(name)] = taxonomy.names.index(other)
    return table


def official(labels: np.ndarray, taxonomy: Any) -> np.ndarray:
    """Return the train ids of PandaSet's labels, 0 where the weights have no such class."""
    table = np.zeros(256, int)
    for raw, name in OFFICIAL.items():
        table[raw] = taxonomy.names.index(name)
    return table[labels]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scan", type=Path)
    parser.add_argument("labels", type=Path)
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).parent / "figures/perspective.png"
    )
    arguments = parser.parse_args()

    segmenter = amvnet.load("sim-hdl64e")
    result = segmenter(arguments.scan)
    truth = official(np.load(arguments.labels, allow_pickle=False), segmenter.taxonomy)
    scan = replace(result.require_origin().scan, labels=truth)  # its origin is the sensor
    sheet = draw(scan, result, segmenter.taxonomy, CAMERA)
    reduced(sheet, segmenter.taxonomy).save(arguments.out, optimize=True)
    print(arguments.out, sheet.size, arguments.out.stat().st_size)


if __name__ == "__main__":
    main()
