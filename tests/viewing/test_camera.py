"""The camera of the page, run by Node: dragging keeps it over the ground."""

from __future__ import annotations

import json
import shutil
import subprocess
from importlib import resources

import pytest

ASSETS = resources.files("amvnet.viewing") / "page_assets"
NODE = shutil.which("node")

pytestmark = pytest.mark.skipif(NODE is None, reason="Node is not installed")


def run_camera(code: str) -> float:
    """Return a number that code computes with a `camera` at its first place."""
    source = (ASSETS / "camera.js").read_text(encoding="utf-8")
    script = f"{source}\nconst camera = new Camera();\nconsole.log(JSON.stringify({code}));"
    result = subprocess.run([str(NODE), "-e", script], capture_output=True, text=True, check=True)
    return float(json.loads(result.stdout))


def test_a_small_drag_leaves_the_camera_above_the_ground() -> None:
    # A tenth of the window's height, the way that lowers the camera.
    elevation = run_camera("(camera.turn(0, -0.1), camera.elevation)")
    assert elevation > 0.6 * run_camera("camera.elevation")


def test_no_drag_takes_the_camera_under_the_ground() -> None:
    height = "camera.distance * camera.axes().back[2]"
    assert run_camera(f"(camera.turn(0, -9), {height})") > 0


def test_a_drag_over_the_height_of_the_window_turns_by_half_a_circle() -> None:
    before = run_camera("camera.azimuth")
    after = run_camera("(camera.turn(1, 0), camera.azimuth)")
    assert abs(before - after) == pytest.approx(3.14159, abs=1e-4)
