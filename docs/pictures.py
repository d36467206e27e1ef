"""Take the pictures of README.md and of the pages in the viewer, with Chromium.

    python docs/pictures.py viewer SCAN.bin LABELS.npy   # README's moving picture: scan 002_00
    python docs/pictures.py hard SCAN.bin LABELS.npy     # a scan that is hard to label: 001_00
    python docs/pictures.py map                          # the map of a simulated drive
    python docs/pictures.py page                         # the page of `amvnet view`
    python docs/pictures.py try                          # the page of web/

The first two show scans of PandaSet by Hesai and Scale AI (CC BY 4.0): rows of float32 with x
forward, y left and z up in metres, and intensity in [0, 1], and PandaSet's ids, one for each point.
Needs Chromium, Node.js and the packages of web/ (`npm ci --prefix web`).
"""

from __future__ import annotations

import json
import math
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import matplotlib as mpl
import numpy as np
from PIL import Image, ImageDraw, ImageFont

import amvnet
from amvnet.cli.main import DONE, main
from amvnet.data.taxonomy import Taxonomy, class_colors
from amvnet.viewing.page import write_page
from amvnet.viewing.shown_scans import ShownScan, shown_scan

DOCS = Path(__file__).parent
ROOT = DOCS.parent
FIGURES = DOCS / "figures"
WIDE = (960, 540)  # the sizes of pictures, pixels
LARGE = (1280, 800)
MAP_SEED = 100  # of a street with parked cars on both sides

# Expressions of a page that are true when its picture can be taken.
IS_DRAWN = "document.documentElement.dataset.drawn && drawing.matrix"
IS_LABELLED = """(() => {
  const { state } = document.documentElement.dataset;
  const { contentDocument } = document.querySelector("iframe");
  if (state === "shown") document.getElementById("label").click();
  return state === "labelled" && contentDocument.documentElement.dataset.drawn;
})()"""
# Scripts of a page before its picture: the second leaves nothing but points.
WITHOUT_TIME = """
document.getElementById("state").hidden = true;
document.querySelector("iframe").contentWindow.draw();
"""
POINTS_ALONE = "byId('panel').hidden = byId('camera').hidden = true; look.size = 1.6;"

# The sheet of the hard scan.
INK = (232, 236, 243)
BACKGROUND = (8, 11, 17)
GAP = 8  # the distance between panels, pixels
LEGEND_COLUMNS = 6
LEGEND_ROW = 40  # pixels

# The moving picture: the time of a frame, the frames of each part, and the quality of the file.
FRAME = 80  # milliseconds
SWING = 24  # frames of the camera's way in each direction
SWEEP = 26  # frames in which the points get their labels
REST = 1200  # how long the picture shows all labels without a movement, milliseconds
UNLABELLED_REST = 500  # how long it shows the scan without labels, milliseconds
QUALITY = 55

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
    """A position of the viewer's camera around its target, in radians and metres."""

    azimuth: float
    elevation: float
    distance: float
    target: tuple[float, float, float]

    @property
    def script(self) -> str:
        """The script that moves the camera there."""
        place = {"azimuth": self.azimuth, "elevation": self.elevation, "distance": self.distance}
        return f"camera.set({json.dumps({**place, 'target': self.target})}); draw();"


HIGH = Camera(3.6, 0.55, 46, (4, 0, -1))  # the viewer's first view
LOW = Camera(3.05, 0.26, 29, (11, 0, 0))
BEHIND = Camera(math.pi, 0.3, 27, (10, -0.5, -0.1))
ALONG = Camera(3.5, 0.45, 60, (26, 0, -2))

# A script of the page that leaves the title and the classes in the panel. `labelled(share)` shows
# the labels of the points in a share of a turn of the sensor.
LEGEND_ALONE = """
look.size = 1.4;
for (const section of byId("folding").children) section.hidden = section.id !== "classes-section";
byId("camera").hidden = byId("fold").hidden = byId("all").hidden = byId("none").hidden = true;
const labels = scan.planes[look.labels], turns = new Float32Array(scan.count);
for (let i = 0; i < scan.count; i++) {
  const [x, y] = placeOf(scan, i);
  turns[i] = (2.25 - Math.atan2(y, x) / (2 * Math.PI)) % 1;
}
window.labelled = (share) => {
  scan.planes[look.labels] = labels.map((label, i) => (turns[i] < share ? label : 0));
  drawing.refresh(scan, look.labels);
  panel.show(look, scan);
  draw();
};
"""


def viewer(scan: Path, official_labels: Path) -> None:
    """Write the moving picture: the camera goes through a scan, which then gets its labels."""
    result = amvnet.load()(scan)
    origin = result.require_origin()
    shown = replace(shown_scan(result, origin), name="PandaSet")
    print(f"{compare(result, official_labels).error:.1%} of the compared points have a wrong label")

    shots = [(f"{LEGEND_ALONE} {HIGH.script}", REST)]
    shots += [(between(HIGH, LOW, step / SWING).script, FRAME) for step in range(1, SWING)]
    shots.append((LOW.script, REST))
    shots += [(between(LOW, HIGH, step / SWING).script, FRAME) for step in range(1, SWING + 1)]
    shots.append(("labelled(0);", UNLABELLED_REST))
    shots += [(f"labelled({step / SWEEP});", FRAME) for step in range(1, SWEEP)]

    with page_of(shown, origin.taxonomy, "A street, labelled") as url:
        first, *others = photograph(url, IS_DRAWN, [script for script, _ in shots], WIDE)
    durations = [duration for _, duration in shots]
    first.save(
        FIGURES / "viewer.webp",
        save_all=True,
        append_images=others,
        duration=durations,
        loop=0,
        quality=QUALITY,
        method=6,
    )


def between(start: Camera, end: Camera, share: float) -> Camera:
    """Return the camera on its way from one place to another; it starts and stops slowly."""
    eased = (1 - math.cos(math.pi * share)) / 2

    def mix(one: float, other: float) -> float:
        return one + eased * (other - one)

    return Camera(
        mix(start.azimuth, end.azimuth),
        mix(start.elevation, end.elevation),
        mix(start.distance, end.distance),
        (
            mix(start.target[0], end.target[0]),
            mix(start.target[1], end.target[1]),
            mix(start.target[2], end.target[2]),
        ),
    )


def hard(scan: Path, official_labels: Path) -> None:
    """Write four pictures of a scan: official labels, labels, uncertain points, wrong labels."""
    result = amvnet.load()(scan)
    origin = result.require_origin()
    taxonomy = origin.taxonomy
    compared = compare(result, official_labels)
    truth = compared.truth
    labels = compared.labels
    shown = shown_scan(result, replace(origin, scan=replace(origin.scan, labels=truth)))
    shown = replace(shown, labels={"amvnet": labels})

    doubt = result.uncertain[origin.scan.valid].mean()
    panels = {
        "Official labels (grey: not compared)": {"labels": "truth", "color": "class"},
        "AMVNet": {"labels": "amvnet", "color": "class"},
        f"The two networks disagree on {doubt:.0%} of the points": {"color": "uncertainty"},
        f"Wrong labels: {compared.error:.0%} of the compared points": {"color": "error"},
    }
    scripts = []
    for look in panels.values():
        scripts.append(f"look.set({json.dumps(look)}); {POINTS_ALONE} {BEHIND.script}")
    with page_of(shown, taxonomy, "") as url:
        pictures = photograph(url, IS_DRAWN, scripts, WIDE)

    width, height = WIDE
    present = np.union1d(truth[truth > 0], labels[labels > 0])
    sheet = Image.new(
        "RGB", (2 * width + GAP, 2 * height + GAP + legend_height(present)), BACKGROUND
    )
    pen = ImageDraw.Draw(sheet)
    for number, (title, picture) in enumerate(zip(panels, pictures, strict=True)):
        place = (number % 2 * (width + GAP), number // 2 * (height + GAP))
        sheet.paste(picture, place)
        pen.text((place[0] + 22, place[1] + 16), title, fill=INK, font=font(26))
    draw_legend(pen, taxonomy, present, 2 * height + GAP)
    sheet.save(FIGURES / "hard_scan.png", optimize=True)


def map_of_drive() -> None:
    """Write the picture of the map of a simulated drive: classes and, on the right, heights."""
    with tempfile.TemporaryDirectory() as name:
        drive = amvnet.simulate(Path(name, "drive"), scans=60, spacing=1, seed=MAP_SEED)
        cloud = Path(name, "map.ply")
        page = Path(name, "map.html")
        run("map", drive, "--out", cloud, "--voxel", 0.1)
        run("view", cloud, "--labels", cloud, "--taxonomy", "semantickitti", "--html", page)
        by_class = f"look.size = 1.5; {ALONG.script}"
        by_height = "look.set({color: 'height'}); draw();"
        picture, heights = photograph(page.as_uri(), IS_DRAWN, [by_class, by_height], LARGE)
    width, height = LARGE
    right = (width * 5 // 8, 0, width, height)
    picture.paste(heights.crop(right), right)
    picture.save(FIGURES / "map.png", optimize=True)


def page_of_view() -> None:
    """Write the picture of the page in docs/viewing.md."""
    with tempfile.TemporaryDirectory() as name:
        city = amvnet.simulate(Path(name, "city"), scans=2, seed=8)
        page = Path(name, "city.html")
        run("view", city, "--weights", "auto", "--html", page)
        (picture,) = photograph(page.as_uri(), IS_DRAWN, ["draw();"], LARGE)
    picture.save(DOCS / "page.png", optimize=True)


def page_in_the_browser() -> None:
    """Write the picture of the page of web/, after it has labelled its sample scan."""
    with tempfile.TemporaryDirectory() as name:
        subprocess.run([sys.executable, str(ROOT / "web/build.py"), name], check=True)
        handler = partial(SimpleHTTPRequestHandler, directory=name)
        server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        url = f"http://127.0.0.1:{server.server_port}/index.html"
        (picture,) = photograph(url, IS_LABELLED, [WITHOUT_TIME], LARGE)
        server.shutdown()
    picture.save(DOCS / "try.png", optimize=True)


def run(*words: object) -> None:
    """Run a command of amvnet."""
    if main(list(map(str, words))) != DONE:
        raise RuntimeError(f"expected `amvnet {words[0]}` to succeed")


@contextmanager
def page_of(shown: ShownScan, taxonomy: Taxonomy, title: str) -> Iterator[str]:
    """Yield the address of a page that shows a scan, and delete the page then."""
    with tempfile.TemporaryDirectory() as name:
        page = Path(name, "page.html")
        write_page(page, [shown], taxonomy, title)
        yield page.as_uri()


def photograph(
    url: str, is_ready: str, scripts: list[str], size: tuple[int, int]
) -> list[Image.Image]:
    """Return a picture of a page after each of some scripts, which run one after the other."""
    with tempfile.TemporaryDirectory() as name:
        paths = [Path(name, f"{number}.png") for number in range(len(scripts))]
        shots = []
        for script, path in zip(scripts, paths, strict=True):
            shots.append({"script": script, "path": str(path)})
        job = {
            "playwright": str(ROOT / "web/node_modules/playwright-core"),
            "chromium": shutil.which("chromium") or shutil.which("google-chrome"),
            "url": url,
            "size": size,
            "isReady": is_ready,
            "shots": shots,
        }
        file = Path(name, "job.json")
        file.write_text(json.dumps(job), encoding="utf-8")
        subprocess.run(["node", str(DOCS / "pictures.mjs"), str(file)], check=True)
        return [Image.open(path).convert("RGB") for path in paths]


def draw_legend(
    pen: ImageDraw.ImageDraw, taxonomy: Taxonomy, present: np.ndarray, top: int
) -> None:
    """Write the names and colours of classes in rows below the panels."""
    colors = class_colors(taxonomy)
    step = (2 * WIDE[0] + GAP - 30) / LEGEND_COLUMNS
    for place, class_id in enumerate(present):
        x = 22 + place % LEGEND_COLUMNS * step
        y = top + 14 + place // LEGEND_COLUMNS * LEGEND_ROW
        pen.rounded_rectangle((x, y + 4, x + 20, y + 24), 5, fill=colors[class_id])
        pen.text((x + 30, y), taxonomy.classes[class_id - 1], fill=INK, font=font(20))


def legend_height(present: np.ndarray) -> int:
    """Return the height of the legend in pixels."""
    return 20 + LEGEND_ROW * -(-len(present) // LEGEND_COLUMNS)


def font(size: int) -> ImageFont.FreeTypeFont:
    """Return DejaVu Sans, which matplotlib brings."""
    file = Path(mpl.get_data_path(), "fonts/ttf/DejaVuSans.ttf")
    return ImageFont.truetype(str(file), size)


@dataclass(frozen=True)
class Compared:
    """The official labels of a scan, and its labels in the official classes, as train ids."""

    truth: np.ndarray
    labels: np.ndarray

    @property
    def error(self) -> float:
        """The share of wrong labels, of the points that have an official label."""
        is_compared = (self.truth > 0) & (self.labels > 0)
        return float(np.mean(self.labels[is_compared] != self.truth[is_compared]))


def compare(result: amvnet.Segmentation, official_labels: Path) -> Compared:
    """Return the labels of a scan of PandaSet together with its official labels."""
    names = result.require_origin().taxonomy.names
    of_raw = np.zeros(256, int)
    for raw, name in OFFICIAL.items():
        of_raw[raw] = names.index(name)
    shown_as = np.arange(len(names))
    for name, other in MERGED.items():
        shown_as[names.index(name)] = names.index(other)
    truth = of_raw[np.load(official_labels, allow_pickle=False)]
    return Compared(truth, shown_as[result.labels])


PICTURES: dict[str, Callable[..., None]] = {
    "viewer": viewer,
    "hard": hard,
    "map": map_of_drive,
    "page": page_of_view,
    "try": page_in_the_browser,
}

if __name__ == "__main__":
    PICTURES[sys.argv[1]](*map(Path, sys.argv[2:]))
