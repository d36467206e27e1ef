"""Draw one simulated scan in perspective, from behind and above the car: the picture of README.md.

    python docs/perspective.py [--seed 80] [--sequence 7] [--scan 0] [--out FILE.png]

Four panels: ground truth, AMVNet's labels, the uncertain points, and the wrong labels. Points are
drawn as discs whose size follows their distance, the nearest on top, at twice the resolution of the
picture.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

import amvnet
from amvnet.data import palette

PANEL = (1000, 560)  # pixels, width and height
GAP = 8  # pixels between panels
OVERSAMPLE = 2
LEGEND = 56  # pixels, height of a row
MOST_COLUMNS = 10  # of the legend
LEAST = 40  # points of a class in the legend, of both upper panels

BACKGROUND = np.array([13, 16, 22], np.float32)
INK = (226, 230, 238)
PLAIN = (74, 82, 96)  # points that a panel says nothing about
CAR = (196, 204, 216)

DISC = 0.0032  # radius of a point in metres, per metre from the sensor: it fills the gaps of a wall
SMALLEST = 0.028  # metres
FOG = 120.0  # metres at which a colour has lost 63 % of its contrast
REACH = 75.0  # metres from the sensor
DARKEST = 105.0  # luminance that class colours are lifted to, for a dark background


# The car, seen from its side: x forward and height over the ground in metres, from tail to nose.
PROFILE = (
    (-2.25, 0.35), (-2.25, 0.95), (-1.95, 1.02), (-1.35, 1.42),
    (0.35, 1.42), (1.05, 1.0), (2.1, 0.85), (2.2, 0.35),
)  # fmt: skip
BRIGHTNESS = (0.55, 0.85, 0.3, 1.0, 0.3, 0.9, 0.5)  # of each part; windows are dark
HALF_WIDTH = 0.9
SENSOR_HEIGHT = 1.73


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


def car_points() -> tuple[np.ndarray, np.ndarray]:
    """Return the surface of the sensor's car as (N, 3) points and their brightness (N,)."""
    rng = np.random.default_rng(0)
    pieces = []
    for (x0, z0), (x1, z1), brightness in zip(PROFILE[:-1], PROFILE[1:], BRIGHTNESS, strict=True):
        share = rng.random(40_000)
        across = rng.uniform(-HALF_WIDTH, HALF_WIDTH, 40_000)
        pieces.append((x0 + share * (x1 - x0), across, z0 + share * (z1 - z0), brightness))

    x = rng.uniform(PROFILE[0][0], PROFILE[-1][0], 80_000)
    z = rng.uniform(PROFILE[0][1], 1.42, 80_000)
    below_roof = z < np.interp(x, *np.array(PROFILE[1:-1]).T)
    for side in (-HALF_WIDTH, HALF_WIDTH):
        pieces.append((x[below_roof], np.full(below_roof.sum(), side), z[below_roof], 0.5))

    angle = rng.uniform(-np.pi, np.pi, 20_000)
    height = rng.uniform(1.42, 1.80, 20_000)
    pieces.append((0.14 * np.cos(angle), 0.14 * np.sin(angle), height, 0.22))

    points = np.concatenate([np.stack([x, y, z], axis=1) for x, y, z, _ in pieces])
    points[:, 2] -= SENSOR_HEIGHT
    return points, np.concatenate([np.full(len(x), brightness) for x, _, _, brightness in pieces])


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
    labels = result.labels[shown]
    truth = scan.labels[shown]
    uncertain = result.uncertain[shown]
    wrong = (labels != truth) & (truth > 0)

    body, brightness = car_points()
    metal = np.array(CAR, np.float32) * brightness[:, None]
    everything = np.concatenate([xyz, body])
    texture = (0.82 + 0.36 * scan.points[shown, 3:4]).astype(np.float32)
    radius = np.maximum(DISC * distance, SMALLEST)

    def panel(colors: np.ndarray, marked: np.ndarray | None = None) -> Image.Image:
        sizes = radius if marked is None else np.where(marked, 1.25 * radius, radius)
        sizes = np.concatenate([sizes, np.full(len(body), 0.025)])
        return render(camera, everything, np.concatenate([colors, metal]), sizes)

    def by_class(labels: np.ndarray) -> Image.Image:
        return panel(np.clip(class_colors(taxonomy, labels) * texture, 0, 255))

    def highlight(marked: np.ndarray, color: tuple[int, int, int]) -> Image.Image:
        plain = np.array(PLAIN, np.float32) * texture
        return panel(np.where(marked[:, None], np.array(color, np.float32), plain), marked)

    share = result.uncertain[scan.valid].mean()
    labelled = scan.valid & (scan.labels > 0)
    right = (result.labels == scan.labels)[labelled].mean()
    panels = [
        ("Ground truth", by_class(truth)),
        ("AMVNet", by_class(labels)),
        (
            f"Uncertain: the two networks disagree on {share:.0%} of the points",
            highlight(uncertain, palette.UNCERTAIN),
        ),
        (f"Wrong labels: {1 - right:.1%} of the points", highlight(wrong, palette.WRONG)),
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
    return -(-np.count_nonzero(present) // MOST_COLUMNS)


def reduced(sheet: Image.Image, taxonomy: Any) -> Image.Image:
    """Return the picture in 256 colours, those of the classes among them: a third of the file."""
    sample = Image.new("RGB", (sheet.width, sheet.height + 20 * taxonomy.size))
    sample.paste(sheet, (0, 0))
    for place, color in enumerate(class_colors(taxonomy, np.arange(1, taxonomy.size + 1))):
        top = sheet.height + 20 * place
        sample.paste(tuple(int(c) for c in color), (0, top, sheet.width, top + 20))
    palette = sample.quantize(256, method=Image.Quantize.MEDIANCUT, kmeans=2)
    return sheet.quantize(palette=palette, dither=Image.Dither.NONE)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=80)
    parser.add_argument("--sequence", type=int, default=7)
    parser.add_argument("--scan", type=int, default=0)
    parser.add_argument("--data", type=Path)
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).parent / "figures/perspective.png"
    )
    arguments = parser.parse_args()
    segmenter = amvnet.load("sim-hdl64e")
    with TemporaryDirectory() as folder:
        data = arguments.data or amvnet.simulate(
            folder, sequences=1, first_sequence=arguments.sequence, scans=2, seed=arguments.seed
        )
        scan = read(
            Path(data), f"{arguments.sequence:02d}", f"{arguments.scan:06d}", segmenter.taxonomy
        )
    camera = Camera(eye=(-20.5, -0.5, 9.5), target=(12.0, -0.5, -0.1), field_of_view=53)
    sheet = draw(scan, segmenter(scan), segmenter.taxonomy, camera)
    reduced(sheet, segmenter.taxonomy).save(arguments.out, optimize=True)
    print(arguments.out, sheet.size, arguments.out.stat().st_size)


def read(folder: Path, sequence: str, name: str, taxonomy: Any) -> amvnet.Scan:
    """Read a scan and its labels from SemanticKITTI's layout."""
    place = folder / "sequences" / sequence
    points = np.fromfile(place / "velodyne" / f"{name}.bin", np.float32).reshape(-1, 4)
    raw = np.fromfile(place / "labels" / f"{name}.label", np.uint32) & 0xFFFF
    return amvnet.Scan(points, taxonomy.to_train(raw))


if __name__ == "__main__":
    main()
