"""The modules of web/ do what the package does, number by number: run in Node.js."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
import subprocess
from collections import ChainMap
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from amvnet import onnx_runner
from amvnet import scan as scans
from amvnet.config import schema
from amvnet.config.nested import to_dict
from amvnet.config.schema import AssertionConfig, PolarViewConfig
from amvnet.data.formats import cloud, fields, numpy_files, pcd, raw, rows
from amvnet.data.formats.detect import ending_of
from amvnet.data.formats.registry import read_file
from amvnet.data.formats.rows import UNKNOWN
from amvnet.data.recordings import Recording, ScanFile
from amvnet.errors import InputError
from amvnet.inference import segmentation
from amvnet.models import assertion
from amvnet.models.neighbours import nearest_others
from amvnet.models.views import polar_view
from amvnet.onnx_runner import distances, image_rows, polar_features, range_image, scores_of_points
from amvnet.scan import Scan
from amvnet.sensors import built_in, frame, ground, intensity, lasers, own_body
from amvnet.sensors import rows as sensor_rows
from amvnet.sensors.expectation import Expectation
from amvnet.sensors.intensity import PROBABILITIES, TrainedIntensity
from amvnet.sensors.lasers import lasers_by_order
from amvnet.sensors.lidars import ANY, rotation_from_degrees
from amvnet.sensors.normalise import Normaliser
from amvnet.weights import verdict
from amvnet.weights.file import load

from fixtures.commands import new_file
from fixtures.marks import with_quick
from fixtures.processes import PATIENCE
from fixtures.scan_writers import WRITERS, pcd_bytes, some_points
from fixtures.sensors import LASERS, between_bent_walls, on_nuscenes_car, place

NODE = shutil.which("node")
PAGE = Path(__file__).parents[2] / "web"
DRIVER = Path(__file__).parents[1] / "fixtures" / "web_modules.mjs"
FORMATS = ("kitti.bin", "ascii.pcd", "binary.pcd", "compressed.pcd", "ascii.ply", "little.ply")
# The page chooses among its own weights, so it names no built-in ones.
NO_OTHERS = re.compile("; [^;]* would fit$")
POLAR = PolarViewConfig(radial=40, angular=36, vertical=8, nearest=6)
NEIGHBOURS = 15
K = 3  # number of classes whose scores are made up
FLOATS = (".points", ".image", ".features", ".scores")  # the arrays of float32; others are int32

load_once = cache(load)

pytestmark = pytest.mark.skipif(NODE is None, reason="Node.js is not installed")


@dataclass(frozen=True)
class Case:
    """A scan file, the weights that it is normalised for, and what of them is changed."""

    file: Path
    weights: str = "sim-hdl64e"
    rows: Literal["elevation", "laser", "ring"] | None = None
    intensity: TrainedIntensity | None = None
    sensor: dict[str, Any] = field(default_factory=dict)

    @property
    def expected(self) -> Expectation:
        expected = load_once(self.weights).expects
        view = expected.view
        rows = self.rows or view.rows
        # Coarse images have hidden points.
        view = dataclasses.replace(view, rows=rows, width=view.width // 8, hidden=0.02, nearest=6)
        intensity = self.intensity or expected.intensity
        sensor = dataclasses.replace(expected.sensor, **self.sensor)
        return dataclasses.replace(expected, view=view, intensity=intensity, sensor=sensor)


def run_page(cases: list[Case], folder: Path) -> list[dict[str, Any]]:
    """Return what the page's modules make of scans: {text, points, rows, ...} or {error}."""
    jobs = []
    for index, case in enumerate(cases):
        job = {
            "file": str(case.file),
            "out": str(folder / str(index)),
            "polarView": to_dict(POLAR),
            "own": list(range(0, 30_000, 97)),
            "n": NEIGHBOURS,
            "expected": {"view": to_dict(case.expected.view), **case.expected.to_dict()},
        }
        jobs.append(job)
    listing = new_file(folder / "jobs.json", json.dumps(jobs))
    command = [str(NODE), str(DRIVER), str(PAGE), str(listing)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr

    results: list[dict[str, Any]] = json.loads(done.stdout)
    for index, result in enumerate(results):
        if "text" not in result:
            continue
        for path in folder.glob(f"{index}.*"):
            kind = np.float32 if path.suffix in FLOATS else np.int32
            result[path.suffix[1:]] = np.fromfile(path, kind)
    return results


def normalised(case: Case) -> tuple[Scan, str]:
    """Return the scan as the package normalises it, and what it says."""
    lines: list[str] = []
    normaliser = Normaliser(case.expected, report=lines.append)
    cloud = read_file(case.file, ending_of(case.file), UNKNOWN)
    recording = Recording("scans")
    recording.scans.append(ScanFile("scan", recording, case.file, read=lambda: cloud))
    scan = normaliser(recording).to_scan(cloud)
    (line,) = lines
    return scan, line.removeprefix(f"{case.file}: ")


def write_bin(path: Path, points: np.ndarray) -> Path:
    path.write_bytes(np.ascontiguousarray(points, np.float32).tobytes())
    return path


def with_ring(points: np.ndarray, laser: np.ndarray, scale: float = 255) -> np.ndarray:
    return np.column_stack([points * [1, 1, 1, scale], laser])


def by_laser(points: np.ndarray, laser: np.ndarray) -> np.ndarray:
    turn = np.mod(np.arctan2(points[:, 1], points[:, 0]), 2 * np.pi)
    return points[np.lexsort([turn, -laser])]


def of_hdl32e(folder: Path, table: np.ndarray, rows: Any) -> Case:
    return Case(write_bin(folder / "scan.pcd.bin", table), "sim-hdl32e", rows=rows)


HDL64E = np.linspace(-23.9, 3, 64)
HALF_A_STEP = rotation_from_degrees(0.5, 0, 0).T  # after it, no point lies straight ahead


def kitti_like(folder: Path) -> Case:
    points, laser = place(HDL64E, 1.73)
    points = by_laser(points, laser)
    points[1000:1010, :3] = 0  # lost returns
    return Case(write_bin(folder / "kitti_like.bin", points), rows="laser")


def in_another_order(folder: Path) -> Case:
    points, _ = place(HDL64E, 1.73)
    return Case(write_bin(folder / "order.bin", points), rows="laser")


def by_elevation(folder: Path) -> Case:
    points, laser = place(HDL64E, 1.73)
    return Case(write_bin(folder / "elevation.bin", by_laser(points, laser)), rows="elevation")


def nuscenes_like(folder: Path) -> Case:
    points, laser = place(LASERS["hdl32e"], 1.84, steps=700)
    return of_hdl32e(folder, with_ring(points, laser), "ring")


def on_the_car_of_nuscenes(folder: Path) -> Case:
    points, laser = on_nuscenes_car()
    return of_hdl32e(folder, with_ring(points, laser), "ring")


def on_the_car_of_nuscenes_in_millimetres(folder: Path) -> Case:
    points, laser = on_nuscenes_car()
    np.save(folder / "own_car.npy", with_ring(points, laser) * [1000.0, 1000, 1000, 1, 1])
    return Case(folder / "own_car.npy", "sim-hdl32e", rows="ring")


def of_few_points_on_the_car_of_nuscenes(folder: Path) -> Case:
    """Of every seventh point, too few are distant to know the lasers."""
    points, laser = on_nuscenes_car(share=0.4, steps=20)
    return Case(write_bin(folder / "few_own.pcd.bin", with_ring(points, laser)), "sim-hdl32e")


def near_points_alone(folder: Path) -> Case:
    points, laser = on_nuscenes_car()
    near = np.hypot(points[:, 0], points[:, 1]) < 1
    return Case(write_bin(folder / "near.bin", with_ring(points, laser)[near]), "sim-hdl32e")


def near_points_of_another_sensor(folder: Path) -> Case:
    points, laser = on_nuscenes_car(sensor="os1-64")
    return Case(write_bin(folder / "near.bin", with_ring(points, laser)), rows="laser")


def with_lasers_in_a_column(folder: Path) -> Case:
    points, laser = place(LASERS["hdl32e"], 1.84, steps=700)
    return of_hdl32e(folder, with_ring(points, laser), "laser")


def higher_with_lost_returns(folder: Path) -> Case:
    points, _ = place(HDL64E, 2.4)
    points[::50, :3] = 0
    points[7::50, :3] = np.nan
    points[9::50, 3] = np.nan
    return Case(write_bin(folder / "higher.bin", points))


def of_another_sensor(folder: Path) -> Case:
    points, laser = place(LASERS["os1-64"], 1.9)
    return Case(write_bin(folder / "ouster.bin", with_ring(points, laser)), rows="laser")


def of_fewer_lasers(folder: Path) -> Case:
    points, laser = place(LASERS["vlp16"], 1.9, steps=1000)
    path = write_bin(folder / "vlp16.bin", with_ring(points, laser))
    return Case(path, "sim-hdl32e", rows="ring")


def with_rings_from_the_highest(folder: Path) -> Case:
    points, laser = place(LASERS["hdl32e"], 1.84, steps=700)
    return of_hdl32e(folder, with_ring(points, 31 - laser), "ring")


def with_permuted_rings(folder: Path) -> Case:
    points, laser = place(LASERS["hdl32e"], 1.84, steps=700)
    order = np.random.default_rng(0).permutation(32)
    return of_hdl32e(folder, with_ring(points, order[laser]), "laser")


def with_a_laser_that_sees_only_the_car(
    near: int, radius: float, order: Callable[[np.ndarray], np.ndarray], folder: Path
) -> Case:
    points, laser = place(LASERS["hdl32e"], 1.84, steps=700)
    points[laser == near, :2] *= radius / np.hypot(*points[laser == near, :2].T)[:, None]
    return of_hdl32e(folder, with_ring(points, order(laser)), "laser")


def of_more_lasers(folder: Path) -> Case:
    points, laser = place(np.linspace(-30.67, 10.67, 48), 1.84, steps=700)
    return of_hdl32e(folder, with_ring(points, laser), "laser")


def of_half_the_lasers(folder: Path) -> Case:
    points, laser = on_nuscenes_car()
    ring = laser // 2  # as of 16 lasers between the same elevations
    return of_hdl32e(folder, with_ring(points, ring), "laser")


def with_dead_lasers(folder: Path) -> Case:
    points, laser = place(LASERS["hdl32e"], 1.84, steps=700)
    return of_hdl32e(folder, with_ring(points, 31 - laser)[laser % 3 != 1], "laser")


def with_raised_lasers(first: int, steps: int, folder: Path) -> Case:
    """The lasers from the first one on look higher by steps between lasers."""
    elevations = LASERS["hdl32e"] + steps * np.diff(LASERS["hdl32e"])[0] * (np.arange(32) >= first)
    points, laser = place(elevations, 1.84, steps=300)
    return of_hdl32e(folder, with_ring(points, laser), "ring")


def with_rings_and_places_of_lost_returns(folder: Path) -> Case:
    """With the lost returns, the rings would be too many, and the car's body would show."""
    case = with_raised_lasers(12, 2, folder)
    table = np.fromfile(case.file, np.float32).reshape(-1, 5)
    table[::9, :3] = (0.3, 0.3, -0.5)
    table[::5, :3] = 0
    table[::5, 4] = 40
    return dataclasses.replace(case, file=write_bin(case.file, table), rows="laser")


def of_a_wider_view(folder: Path) -> Case:
    points, laser = place([*np.linspace(-24, 2, 60), 5, 8, 12, 15], 1.73)
    return Case(write_bin(folder / "wider.bin", with_ring(points, laser)), rows="laser")


def for_another_sensor(make: Callable[[Path], Case], sensor: dict[str, Any], folder: Path) -> Case:
    return dataclasses.replace(make(folder), sensor=sensor)


def on_a_tilted_sensor(folder: Path) -> Case:
    """The lasers keep to their elevations in the file, and not when the ground is level."""
    points, laser = place(HDL64E, 1.73, slope=4)
    points = by_laser(points, laser)
    points[:, :3] = points[:, :3] @ HALF_A_STEP
    return Case(write_bin(folder / "slope.bin", points), rows="laser")


def for_weights_that_match_nothing(
    make: Callable[[Path], Case], is_optional: bool, folder: Path
) -> Case:
    """Change the intensities that the weights know; scans like theirs stay unchanged."""
    quantiles = tuple((np.linspace(0, 1, len(PROBABILITIES)) ** 2).tolist())
    return dataclasses.replace(make(folder), intensity=TrainedIntensity(quantiles, is_optional))


def with_a_ring_of_a_few_points(folder: Path) -> Case:
    points, laser = place(LASERS["hdl32e"], 1.84, steps=700)
    laser[np.flatnonzero(laser == 0)[:5]] = 31
    table = with_ring(points, laser)[(laser < 31) | (points[:, 2] < 0)]
    return Case(write_bin(folder / "few.pcd.bin", table), "sim-hdl32e", rows="ring")


def with_random_rings(folder: Path) -> Case:
    points, laser = place(LASERS["hdl32e"], 1.84, steps=700)
    ring = np.random.default_rng(0).integers(0, 32, len(laser))
    return Case(write_bin(folder / "random.pcd.bin", with_ring(points, ring)), "sim-hdl32e")


def changed(change: Callable[[np.ndarray], np.ndarray], folder: Path) -> Case:
    """Change the points (N, 4) of the scan like KITTI's."""
    case = kitti_like(folder)
    points = np.fromfile(case.file, np.float32).reshape(-1, 4)
    return Case(write_bin(case.file, change(points)), rows="laser")


def tilt(points: np.ndarray) -> np.ndarray:
    turned = points[:, :3] @ HALF_A_STEP @ rotation_from_degrees(0, 14, 0)
    return np.column_stack([turned, points[:, 3]])


def gather(points: np.ndarray) -> np.ndarray:
    """Move every third point to one place, and make pairs of others."""
    points[::3, :3] = (6, -3, 0.5)
    points[1::6, :3] = points[4::6, :3]
    return points


def from_the_lowest(points: np.ndarray) -> np.ndarray:
    ring = lasers_by_order(points, 64)
    assert ring is not None
    return points[np.argsort(ring, kind="stable")]


CHANGES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "tilted_in_order": tilt,
    "in_reverse": lambda points: points[::-1],
    "from_the_lowest": from_the_lowest,
    "mirrored": lambda points: points * [1, -1, 1, 1],
    "glued": lambda points: np.concatenate([points, points * [-1, -1, 1, 1]]),
    "coincident": gather,
    "of_12_bits": lambda points: np.column_stack([points[:, :3], points[:, 3] * 4095 // 1]),
    "of_8_bits": lambda points: np.column_stack(
        [points[:, :3], np.minimum(points[:, 3] * 300 // 1, 255)]
    ),
    "of_half_the_intensities": lambda points: np.column_stack(
        [points[:, :3], np.where(np.arange(len(points)) % 2, points[:, 3], np.nan)]
    ),
    "of_zeros": lambda points: points * [1, 1, 1, 0],
    "of_one_height": lambda points: points * [1, 1, 0, 1] - [0, 0, 1.7, 0],
    "of_few_points_and_lost_ones": lambda points: np.concatenate([points[::6], 0 * points[:900]]),
    "of_1_point": lambda points: points[:1],
    "of_2_points": lambda points: points[:2],
    "of_16_points": lambda points: points[:16],
}


def with_random_rings_of_a_few_points(folder: Path) -> Case:
    case = with_random_rings(folder)
    table = np.fromfile(case.file, np.float32).reshape(-1, 5)
    return dataclasses.replace(case, file=write_bin(case.file, table[::100]))


def with_rings_on_a_tilted_sensor(folder: Path) -> Case:
    points, laser = place(LASERS["hdl32e"], 1.84, steps=700, slope=15)
    return Case(write_bin(folder / "steep.pcd.bin", with_ring(points, 31 - laser)), "sim-hdl32e")


def without_rings(folder: Path) -> Case:
    points, _ = place(LASERS["hdl32e"], 1.84, steps=700)
    return Case(write_bin(folder / "lone32.bin", points), "sim-hdl32e", rows="ring")


def tilted(folder: Path) -> Case:
    points, _ = place(HDL64E, 1.73)
    points[:, :3] = points[:, :3] @ rotation_from_degrees(0, 14, 0)
    return Case(write_bin(folder / "tilted.bin", points))


def with_y_up_in_millimetres(folder: Path) -> Case:
    points, _ = place(HDL64E, 1.73)
    x, y, z, intensity = points.T
    table = np.column_stack([-1000 * y, 1000 * z, -1000 * x, intensity]).astype(np.float64)
    fields = [(name, "F 8", 1) for name in ("x", "y", "z", "intensity")]
    return Case(new_file(folder / "cameras.pcd", pcd_bytes(table, fields)))


def at_the_foot_of_a_vehicle(folder: Path) -> Case:
    points = between_bent_walls(LASERS["os1-64"], 1.73)
    points[:, 2] += 1.33
    return Case(write_bin(folder / "foot.bin", points))


def with_a_low_sensor(folder: Path) -> Case:
    return Case(write_bin(folder / "low.bin", between_bent_walls(LASERS["os1-64"], 0.4)))


def on_the_ground(folder: Path) -> Case:
    points, _ = place(HDL64E, 1.73)
    points[:, 2] += 1.73
    return Case(write_bin(folder / "ground.bin", points))


def on_a_mound(folder: Path) -> Case:
    """The ground is 0.6 m lower from 16 m on: how far cells count decides which level it is."""
    return on_a_step(folder / "mound.bin", 16, -1.9, -2.5)


def on_a_hump(folder: Path) -> Case:
    """The ground is 0.3 m lower from 6 m on, where most of it lies."""
    return on_a_step(folder / "hump.bin", 6, -1.4, -1.7)


def on_a_step(path: Path, radius: float, inner: float, outer: float) -> Case:
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-25, 25, (2, 20_000))
    z = np.where(np.hypot(x, y) < radius, inner, outer) + 1.5 * (rng.random(len(x)) < 0.2)
    return Case(write_bin(path, np.column_stack([x, y, z, rng.random(len(x))])))


def on_random_ground(seed: int, folder: Path) -> Case:
    """A slope with a step, noise and bushes; several points of a cell are equally low."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-25, 25, (2, 3000))
    z = rng.normal(0, 0.1, 2) @ [x, y] - rng.uniform(0.2, 3) + rng.normal(0, 0.04, len(x))
    z += rng.uniform(0, 3, len(x)) * (rng.random(len(x)) < rng.uniform(0, 0.9))
    z -= rng.uniform(0, 1) * (np.hypot(x, y) > rng.uniform(5, 20))
    points = np.column_stack([x, y, z.round(1), rng.random(len(x))])
    return Case(write_bin(folder / "random.bin", points))


def on_a_bank(folder: Path) -> Case:
    """The ground hardly shows under bushes, so that its slope is unsure."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-25, 25, (2, 20_000))
    z = 0.2 * y - 2.5 + rng.uniform(0.2, 2, len(x)) * (rng.random(len(x)) < 0.85)
    return Case(write_bin(folder / "bank.bin", np.column_stack([x, y, z, rng.random(len(x))])))


def under_a_plane(below: float, folder: Path) -> Case:
    """The plane is above the sensor. Far from it, a share of the points lies below it."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-25, 25, (2, 20_000))
    far = np.hypot(x, y) > 20  # half of the points; nearer ones decide the plane
    share = rng.uniform(0, far.mean(), len(x))
    z = 2.0 + 5 * (far & (share < 0.2)) - 5 * (far & (share > far.mean() - below))
    return Case(write_bin(folder / "under.bin", np.column_stack([x, y, z, rng.random(len(x))])))


def between_walls(folder: Path) -> Case:
    """Each of the two walls may be the ground."""
    rng = np.random.default_rng(0)
    x, z = rng.uniform(-25, 25, (2, 20_000))
    y = rng.choice([-2, 2], len(x))
    return Case(write_bin(folder / "walls.bin", np.column_stack([x, y, z, rng.random(len(x))])))


def of_one_elevation(folder: Path) -> Case:
    """All points lie on a line outside the field of view of the weights' sensor."""
    np.save(folder / "line.npy", np.outer(np.linspace(2, 20, 200), [1, 0, 1, 0.02]))
    return Case(folder / "line.npy")


def of_integers_and_nan(folder: Path) -> Case:
    """The header says that the intensities are integers, but some are missing."""
    points, _ = place(HDL64E, 1.73)
    points[:, 3] = np.round(points[:, 3] * 255)
    points[::9, 3] = np.nan
    path = folder / "nan.pcd"
    WRITERS["ascii.pcd"](path, points)
    path.write_bytes(path.read_bytes().replace(b"TYPE F F F F", b"TYPE F F F U"))
    return Case(path)


def without_a_ground(folder: Path) -> Case:
    return Case(write_bin(folder / "few.bin", some_points(4000)))


def without_intensity(folder: Path) -> Case:
    points, _ = place(HDL64E, 1.73)
    points[:, 3] = 0.5
    return Case(write_bin(folder / "constant.bin", points))


def with_odd_intensities(folder: Path) -> Case:
    points, laser = place(HDL64E, 1.73)
    points = by_laser(points, laser)
    points[::30, :3] = 0
    points[::30, 3] = -1  # of lost returns
    points[1::400, 3] = -1
    points[2::400, 3] = np.inf
    return Case(write_bin(folder / "odd.bin", points))


def of_missing_intensities(folder: Path) -> Case:
    points = np.fromfile(bright(folder).file, np.float32).reshape(-1, 4)
    points[::2, 3] = np.nan
    points[1, 3] = np.nan
    return Case(write_bin(folder / "missing.bin", points))


def bright(folder: Path) -> Case:
    points, _ = place(HDL64E, 1.73)
    points[:, 3] = np.round(points[:, 3] ** 4 * 60_000)
    return Case(write_bin(folder / "bright.bin", points))


SCANS: tuple[Callable[[Path], Case], ...] = (
    *(kitti_like, in_another_order, by_elevation, nuscenes_like, on_the_car_of_nuscenes),
    *(on_the_car_of_nuscenes_in_millimetres, of_few_points_on_the_car_of_nuscenes),
    *(near_points_alone, near_points_of_another_sensor, with_lasers_in_a_column),
    *(higher_with_lost_returns, of_another_sensor, of_fewer_lasers, with_rings_from_the_highest),
    *(with_permuted_rings, with_a_ring_of_a_few_points, of_more_lasers, of_half_the_lasers),
    *(with_dead_lasers, with_rings_and_places_of_lost_returns, of_a_wider_view, on_a_tilted_sensor),
    *(with_random_rings, with_random_rings_of_a_few_points, with_rings_on_a_tilted_sensor),
    *(without_rings, tilted, with_y_up_in_millimetres, at_the_foot_of_a_vehicle, with_a_low_sensor),
    *(on_the_ground, on_a_mound, on_a_hump, on_a_bank, between_walls, of_one_elevation),
    *(of_integers_and_nan, without_a_ground, without_intensity, with_odd_intensities),
    *(of_missing_intensities, bright),
)


MAKERS: dict[str, Callable[[Path], Case]] = {make.__name__: make for make in SCANS}
MAKERS |= {name: partial(changed, change) for name, change in CHANGES.items()}
RING_ORDERS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "reversed": lambda laser: 31 - laser,
    "permuted": lambda laser: np.random.default_rng(0).permutation(32)[laser],
}
for near, radius, (name, order) in product((0, 9), (0.9, 0.0), RING_ORDERS.items()):
    make_near = partial(with_a_laser_that_sees_only_the_car, near, radius, order)
    MAKERS[f"near_{near}_{radius}_{name}"] = make_near
for make, is_optional in product((kitti_like, without_intensity, bright), (False, True)):
    name = f"other_{make.__name__}_{is_optional}"
    MAKERS[name] = partial(for_weights_that_match_nothing, make, is_optional)
for first, steps in ((12, 6), (12, 2), (20, 2), (15, 1), (10, 1)):
    MAKERS[f"raised_{first}_{steps}"] = partial(with_raised_lasers, first, steps)
MAKERS |= {f"under_{share}": partial(under_a_plane, share) for share in (0.08, 0.12)}
MAKERS |= {f"ground_{seed}": partial(on_random_ground, seed) for seed in range(20)}
UNKNOWN_SENSORS: dict[str, dict[str, Any]] = {
    "unnamed": {"name": ""},
    "of_unknown_ends": {"fov_up": None, "fov_down": None},
}
for name, (what, sensor) in product(("raised_12_6", "of_fewer_lasers"), UNKNOWN_SENSORS.items()):
    MAKERS[f"{name}_{what}"] = partial(for_another_sensor, MAKERS[name], sensor)
FOR_ANY_SENSOR = (
    *("kitti_like", "in_another_order", "higher_with_lost_returns", "of_another_sensor"),
    *("of_fewer_lasers", "tilted", "raised_12_6", "of_one_elevation", "near_points_alone"),
    *("of_16_points", "of_1_point"),
)
for name in FOR_ANY_SENSOR:
    MAKERS[f"{name}_for_any_sensor"] = partial(for_another_sensor, MAKERS[name], {"name": ANY})
WITH_VIEWS = ("kitti_like", "nuscenes_like", "higher_with_lost_returns", "coincident")
Made = tuple[Case, dict[str, Any]]  # a scan, and what the page makes of it


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Made]:
    """A function that takes the name of a scan."""

    @cache
    def make(name: str) -> Made:
        folder = tmp_path_factory.mktemp(name)
        case = MAKERS[name](folder)
        (result,) = run_page([case], folder)
        return case, result

    return make


@pytest.mark.parametrize("name", with_quick(MAKERS, WITH_VIEWS))
def test_a_scan_is_normalised_as_by_the_package(name: str, made: Callable[[str], Made]) -> None:
    case, page = made(name)
    scan, line = normalised(case)
    valid = scan.valid
    assert page["text"] == NO_OTHERS.sub("", line)

    points = page["points"].reshape(-1, 4)
    assert np.array_equal(page["places"], np.flatnonzero(valid))
    assert np.allclose(points[:, :3], scan.points[valid, :3], atol=1e-4)
    prepared = case.expected.prepare(scan).points[valid]
    assert np.allclose(points[:, 3], prepared[:, 3], atol=1e-5)
    assert (rows_of(case, scan) == page["rows"]).mean() > 0.9995


def rows_of(case: Case, scan: Scan) -> np.ndarray:
    """Return the rows of the valid points as the package decides them, 0 the top."""
    return image_rows(case.expected.view, scan.select(scan.valid))


@pytest.mark.parametrize("name", WITH_VIEWS)
def test_the_views_equal_those_of_the_onnx_runner(name: str, made: Callable[[str], Made]) -> None:
    case, page = made(name)
    points = page["points"].reshape(-1, 4)
    image, pixel = range_image(case.expected.view, Scan(points, row=page["rows"]))
    features, pillar, voxel = polar_features(POLAR, points)

    assert np.array_equal(page["pixel"], pixel)
    assert np.array_equal(page["image"], image.ravel())
    assert np.array_equal(page["pillar"], pillar)
    assert np.array_equal(page["voxel"], voxel)
    assert np.allclose(page["features"], features.ravel(), atol=1e-6)
    assert np.array_equal(page["seen"], distances(points) >= POLAR.nearest)
    assert 0 < page["seen"].mean() < 1


@pytest.mark.parametrize("name", WITH_VIEWS)
def test_scores_of_points_equal_the_onnx_runners(name: str, made: Callable[[str], Made]) -> None:
    case, page = made(name)
    view = case.expected.view
    points = page["points"].reshape(-1, 4)
    image, pixel = range_image(view, Scan(points, row=page["rows"]))
    count = view.height * view.width * K
    scores = (np.arange(count) * 7919 % 1000 / 1000).astype(np.float32).reshape(K, -1).T

    expected = scores_of_points(view, image, pixel, distances(points), scores)

    assert np.allclose(page["scores"], expected.ravel(), atol=1e-5)
    assert not np.allclose(expected, scores[pixel])  # some points are hidden


@pytest.mark.parametrize("name", ["higher_with_lost_returns", "coincident"])
def test_neighbours_are_as_near_as_the_packages(name: str, made: Callable[[str], Made]) -> None:
    _, page = made(name)
    xyz = page["points"].reshape(-1, 4)[:, :3]
    own = np.arange(0, min(30_000, len(xyz)), 97)
    expected = nearest_others(xyz, own, NEIGHBOURS)
    actual = page["neighbours"].reshape(-1, NEIGHBOURS)

    def lengths(near: np.ndarray) -> np.ndarray:
        return np.linalg.norm(xyz[near].astype(np.float64) - xyz[own][:, None], axis=2)

    assert np.allclose(lengths(actual), lengths(expected))
    assert (actual != own[:, None]).all()


@pytest.mark.parametrize("count", [1, 2, 9])
def test_few_points_are_repeated_as_neighbours(count: int, tmp_path: Path) -> None:
    points = some_points(200)
    points[count:] = np.nan
    (page,) = run_page([Case(write_bin(tmp_path / "few.bin", points))], tmp_path)
    expected = nearest_others(points[:count, :3], np.array([0]), NEIGHBOURS)
    assert np.array_equal(page["neighbours"], expected[0])


@pytest.mark.parametrize("lead", [0.0, 1.5, 3.0])
def test_disputed_points_are_those_of_the_onnx_runner(lead: float, tmp_path: Path) -> None:
    f, g = np.random.default_rng(5).dirichlet(np.full(K, 0.3), (2, 2000)).astype(np.float32)
    config = AssertionConfig(lead=lead)
    uncertain = onnx_runner.disagree(config, f, g)
    expected = np.flatnonzero(onnx_runner.disputed_points(config, f, g, uncertain))
    for name, values in (("f", f), ("g", g), ("uncertain", uncertain)):
        values.tofile(tmp_path / name)

    script = f"""
        import {{ readFileSync }} from "node:fs";
        import {{ disputedOf }} from {json.dumps((PAGE / "method/fusion.js").as_uri())};
        const read = (name) => new Uint8Array(readFileSync(name)).buffer;
        const [f, g] = ["f", "g"].map((name) => new Float32Array(read(name)));
        const index = disputedOf(f, g, {K}, new Uint8Array(read("uncertain")), {lead});
        console.log(JSON.stringify([...index]));
    """
    assert NODE is not None
    command = [NODE, "--input-type=module", "-e", script]
    output = subprocess.run(command, cwd=tmp_path, capture_output=True, check=True).stdout
    assert json.loads(output) == expected.tolist()
    assert (len(expected) < np.count_nonzero(uncertain)) == (lead > 0)


@pytest.mark.parametrize("edge", [0, 0.1, 2])
def test_points_share_a_cube_as_in_the_onnx_runner(edge: float, tmp_path: Path) -> None:
    points = some_points(2000)
    index = np.arange(0, 2000, 3)
    expected, cube = onnx_runner.first_in_cubes(points, index, edge)
    points.astype(np.float32).tofile(tmp_path / "points")

    script = f"""
        import {{ readFileSync }} from "node:fs";
        import {{ firstInCubes }} from {json.dumps((PAGE / "method/fusion.js").as_uri())};
        const points = new Float32Array(new Uint8Array(readFileSync("points")).buffer);
        const index = Uint32Array.from({json.dumps(index.tolist())});
        const [first, cube] = firstInCubes(points, index, {edge});
        console.log(JSON.stringify([[...first], [...cube]]));
    """
    assert NODE is not None
    command = [NODE, "--input-type=module", "-e", script]
    output = subprocess.run(command, cwd=tmp_path, capture_output=True, check=True).stdout
    first, place = map(np.array, json.loads(output))
    assert np.array_equal(first[place], expected[cube])


# Where the package has the numbers of a module, by the same names.
PLACES: dict[str, tuple[object, ...]] = {
    "method/fusion.js": (assertion,),
    "method/head.js": (onnx_runner,),
    "method/networks.js": (onnx_runner,),
    "method/polar_view.js": (polar_view,),
    "method/range_view.js": (onnx_runner,),
    "method/verdict.js": (verdict, segmentation),
    "reading/cloud.js": (cloud,),
    "reading/fields.js": (fields,),
    "reading/npy.js": (numpy_files,),
    "reading/pcd.js": (pcd,),
    "reading/raw.js": (raw, rows),
    "sensor/frame.js": (frame, lasers),
    "sensor/ground.js": (ground,),
    "sensor/intensity.js": (intensity,),
    "sensor/normalise.js": (scans, lasers, own_body, frame, built_in),
    "sensor/rows.js": (sensor_rows, lasers, schema),
}
# Those that have other names there.
OTHERS = {
    "KITTI": raw.KITTI_COLUMNS,
    "NUSCENES": raw.NUSCENES_COLUMNS,
    "LEAST_POINTS": lasers.MIN_LASER_POINTS,
    "LEAST_MEASURED": lasers.MIN_POINTS,
    "BINS": len(lasers.ELEVATION_EDGES) - 1,
    "AROUND": lasers.SMOOTHED_BINS // 2,
}
# The page's own ones: limits of its memory, and the leaves of its tree.
OWN_NUMBERS = {"MAX_POINTS", "LEAF", "PART"}


def test_the_numbers_of_the_modules_are_those_of_the_package() -> None:
    """Scans that show each of them would be many."""
    found = []
    for path in sorted(PAGE.glob("*/*.js")):
        module = path.relative_to(PAGE).as_posix()
        if module.startswith("node_modules"):
            continue
        for name, value in re.findall(r"\b([A-Z][A-Z_]+) = (-?\d[\d._e-]*)[,;]", path.read_text()):
            if name not in OWN_NUMBERS:
                known = ChainMap(*map(vars, PLACES[module]), OTHERS)
                assert float(value.replace("_", "")) == known[name], (module, name)
                found.append(module)
    assert set(found) == set(PLACES)
    assert len(found) == 78  # no module writes a number out without its name


READ = [name for name in WRITERS if name.endswith((".bin", ".pcd", ".ply", ".npy"))]


@pytest.mark.parametrize("name", with_quick(READ, ["compressed.pcd", "little.ply"]))
def test_formats_give_the_points_of_the_package(name: str, tmp_path: Path) -> None:
    WRITERS[name](tmp_path / name, some_points(5000))
    case = Case(tmp_path / name)
    (page,) = run_page([case], tmp_path)
    scan, line = normalised(case)
    assert page["text"] == NO_OTHERS.sub("", line)
    assert np.allclose(page["points"].reshape(-1, 4)[:, :3], scan.points[:, :3], atol=1e-6)


def test_a_flag_before_the_coordinates_is_passed_over(tmp_path: Path) -> None:
    WRITERS["ascii.ply"](tmp_path / "plain.ply", some_points(3000))
    header, rows = (tmp_path / "plain.ply").read_bytes().split(b"end_header\n")
    header = header.replace(b"property float x", b"property bool valid\nproperty float x")
    flagged = b"".join(b"1 " + row for row in rows.splitlines(keepends=True))
    (tmp_path / "flagged.ply").write_bytes(header + b"end_header\n" + flagged)

    plain, page = run_page([Case(tmp_path / "plain.ply"), Case(tmp_path / "flagged.ply")], tmp_path)
    assert np.array_equal(page["points"], plain["points"])


@pytest.mark.parametrize("lasers", [32, 1])
def test_integers_of_any_size_are_read(lasers: int, tmp_path: Path) -> None:
    points, laser = place(LASERS["hdl32e"], 1.84)
    kinds = {"x": "f8", "y": "f4", "z": "f8", "Intensity": "u2", "ring": "i8", "time": "u8"}
    table = np.zeros(len(points), list(kinds.items()))
    table["x"], table["y"], table["z"] = points[:, :3].T
    table["Intensity"] = points[:, 3] * 40_000
    table["ring"] = laser % lasers
    fields = [(name, f"{kind[0].upper()} {kind[1]}", 1) for name, kind in kinds.items()]
    path = new_file(tmp_path / "mixed.pcd", pcd_bytes(table, fields))

    case = Case(path, "sim-hdl32e")
    (page,) = run_page([case], tmp_path)
    scan, line = normalised(case)
    assert page["text"] == NO_OTHERS.sub("", line)
    assert ("32 lasers" in line) == (lasers == 32)  # one laser alone is none
    assert np.array_equal(page["rows"], rows_of(case, scan))


def test_arrays_of_any_type_and_order_are_read(tmp_path: Path) -> None:
    points, laser = place(LASERS["os1-64"], 1.73)
    points[7] = 0
    with_rings = np.column_stack((points * [1, 1, 1, 255], laser))
    arrays = {
        "three": points[:, :3],
        "double": points.astype(np.float64),
        "fortran": np.asfortranarray(points),
        "big": points.astype(">f4"),
        "millimetres": np.round(points * [1000, 1000, 1000, 255]).astype(np.int32),
        "rings": with_rings.astype(np.float32),
        "second": points,
        "fortran_rings": np.asfortranarray(with_rings),
    }
    for name, array in arrays.items():
        np.save(tmp_path / f"{name}.npy", array)
    with (tmp_path / "second.npy").open("wb") as file:
        np.lib.format.write_array(file, points, version=(2, 0))
    cases = [Case(tmp_path / f"{name}.npy") for name in arrays]
    for case, page in zip(cases, run_page(cases, tmp_path), strict=True):
        scan, line = normalised(case)
        assert page["text"] == NO_OTHERS.sub("", line)
        compared = 3 if case.file.name == "three.npy" else 4  # missing intensities are drawn
        found = page["points"].reshape(-1, 4)[:, :compared]
        prepared = case.expected.prepare(scan).points[scan.valid, :compared]
        np.testing.assert_allclose(found, prepared, atol=1e-5)
        assert np.array_equal(page["rows"], rows_of(case, scan)), case.file.name


def test_other_arrays_are_refused_in_one_line(tmp_path: Path) -> None:
    points = some_points(3000)
    arrays = {
        "transposed": points.T,
        "transposed_image": np.moveaxis(points.reshape(50, 60, 4), -1, 0),
        "image": points.reshape(50, 60, 4),
        "fields": points.view([(name, "f4") for name in "xyzi"]),
        "text": np.array(["a", "b"]),
        "labels": np.column_stack((points, np.arange(3000) % 7 * 1000)),
        "half": points.astype(np.float16),
    }
    for name, array in arrays.items():
        np.save(tmp_path / f"{name}.npy", array)
    np.save(tmp_path / "pickled.npy", np.array([{}, None], object), allow_pickle=True)
    whole = (tmp_path / "labels.npy").read_bytes()
    (tmp_path / "cut.npy").write_bytes(whole[:-5])
    (tmp_path / "header.npy").write_bytes(whole[:60])
    (tmp_path / "magic.npy").write_bytes(whole[:8])
    (tmp_path / "code.npy").write_bytes(whole.replace(b"'<f8'", b"exit()"))
    paths = sorted(tmp_path.glob("*.npy"))
    assert len(paths) == 12
    for path, page in zip(paths, run_page([Case(path) for path in paths], tmp_path), strict=True):
        assert page["error"].startswith(f"{path.name}: expected "), page
        assert "\n" not in page["error"]
        if path.stem.startswith("transposed"):
            with pytest.raises(InputError) as caught:
                read_file(path, ".npy", UNKNOWN)
            assert page["error"] == str(caught.value).replace(str(path), path.name)


def broken_files(folder: Path) -> list[Path]:
    """Write files that no command can read, in all ways that the readers know."""
    points = some_points(3000)
    for name in FORMATS:
        WRITERS[name](folder / name, points)
    pcd = (folder / "binary.pcd").read_bytes()
    text = (folder / "ascii.pcd").read_bytes()
    packed = (folder / "compressed.pcd").read_bytes()
    ply = (folder / "little.ply").read_bytes()
    kitti = points.tobytes()
    nan = np.full_like(points, np.nan)
    far = points + np.array([5e5, 5e5, 0, 0], np.float32)
    WRITERS["binary.pcd"](folder / "map.pcd", far)
    floor = points[:, :3] * [1, 1, 0.001] - [0, 0, 9]
    classes = np.arange(len(points)) % 9

    files = {
        "odd.bin": kitti[:-3],
        "letters.bin": b"not a scan at all, but a long text" * 300,
        "none.bin": b"",
        "nan.bin": nan.tobytes(),
        "infinite.bin": (points + np.array([np.inf, 0, 0, 0], np.float32)).tobytes(),
        "gaps.bin": with_ring(points, 20 * classes).astype(np.float32).tobytes(),
        "whole.pcd.bin": with_ring(points.round(), classes).astype(np.float32).tobytes(),
        "map.pcd": (folder / "map.pcd").read_bytes(),
        "map.bin": far.tobytes(),
        "centimetres.bin": (points * [100, 100, 100, 1]).astype(np.float32).tobytes(),
        "feet.bin": np.column_stack([floor, points[:, 3]]).astype(np.float32).tobytes(),
        "cut.pcd": pcd[:-1000],
        "cut_text.pcd": text[: len(text) // 2],
        "lines.pcd": b"\n".join(text.split(b"\n")[:-5]) + b"\n" * 60_000,
        "words.pcd": text.replace(b"DATA ascii\n", b"DATA ascii\nfour words of text\n"),
        "cut_packed.pcd": packed[:-100],
        "swapped.pcd": packed[:400] + packed[500:600] + packed[400:500] + packed[600:],
        "claims.pcd": pcd.replace(b"POINTS 3000", b"POINTS 9999999999"),
        "names.pcd": pcd.replace(b"FIELDS x y z", b"FIELDS a b c"),
        "hexadecimal.pcd": text.replace(b"DATA ascii\n", b"DATA ascii\n0x1 1 1 1\n"),
        "encoding.pcd": pcd.replace(b"DATA binary", b"DATA zipped"),
        "types.pcd": pcd.replace(b"TYPE F F", b"TYPE F Q"),
        "header.pcd": pcd[:40],
        "header.ply": ply[:40],
        "cut.ply": ply[:-1000],
        "format.ply": ply.replace(b"binary_little_endian", b"binary_middle_endian"),
        "lists.ply": ply.replace(
            b"property float x", b"property list uchar int i\nproperty float x"
        ),
        "names.ply": ply.replace(b"property float x", b"property float q"),
        "vertex.ply": ply.replace(b"element vertex", b"element points"),
    }
    paths = []
    for name, data in files.items():
        paths.append(folder / name)
        paths[-1].write_bytes(data)
    return paths


# Words that differ: what a library says, and the page's own limit.
OWN_WORDS = ("found a broken file", "expected a scan of at most")


def test_a_broken_file_gives_the_line_of_the_command(tmp_path: Path) -> None:
    paths = broken_files(tmp_path)
    for path, page in zip(paths, run_page([Case(path) for path in paths], tmp_path), strict=True):
        assert "error" in page, path.name
        with pytest.raises(InputError) as caught:
            normalised(Case(path))

        ours = page["error"]
        theirs = str(caught.value).replace(str(path), path.name)
        if any(words in theirs for words in OWN_WORDS):
            assert any(words in ours for words in OWN_WORDS)
        else:
            assert problem_of(ours) == problem_of(theirs)
        # The page has no options: it names those of the command, if they help.
        assert "--" not in ours or "amvnet predict" in ours
        assert "\n" not in ours


def problem_of(line: str) -> str:
    """Return what was expected and found, without the advice."""
    return line.split("; ")[0]


def test_unknown_formats_name_those_that_the_page_reads(tmp_path: Path) -> None:
    names = [name for name in WRITERS if name.endswith((".npz", ".las", ".bag", ".mcap"))]
    for name in names:
        WRITERS[name](tmp_path / name, some_points())
    results = run_page([Case(tmp_path / name) for name in names], tmp_path)
    for name, page in zip(names, results, strict=True):
        assert page["error"].startswith(
            f"{name}: expected a scan file (.pcd.bin, .bin, .pcd, .ply, .npy)"
        )
