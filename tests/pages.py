"""A page as a stranger reads it: by Python's HTML parser, and by Chromium where there is one."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import zlib
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
FLAGS = [
    *(
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-quic",
        "--no-first-run",
        "--hide-scrollbars",
    ),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--virtual-time-budget=6000", "--window-size=800,500"),
]


class Page(HTMLParser):
    """What is in a page: elements with their attributes, and texts by the element's id, or else as `<tag>`."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: dict[str, str] = {}
        self._open = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        self._open = dict(attrs).get("id") or f"<{tag}>"

    def handle_endtag(self, tag: str) -> None:
        self._open = ""

    def handle_data(self, data: str) -> None:
        if self._open:
            self.texts[self._open] = self.texts.get(self._open, "") + data

    @property
    def about(self) -> dict[str, Any]:
        return dict(json.loads(self.texts["about"]))

    def scan(self, place: int) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """(N, 3) float64 metres, and the (N,) uint8 planes of one of its scans."""
        said = self.about["scans"][place]
        data = zlib.decompress(base64.b64decode(self.texts[f"scan-{place}"]))
        rows = np.frombuffer(data, np.uint8).reshape(-1, said["count"])
        changes = rows[0:6:2].astype(np.int64) + 256 * rows[1:6:2].astype(np.int64)
        steps = (changes.cumsum(axis=1) + 2**15) % 2**16 - 2**15
        xyz = steps.T * np.asarray(said["step"]) + np.asarray(said["center"])
        return xyz, dict(zip(said["planes"], rows[6:], strict=True))


def read_page(path: Path) -> Page:
    return Page(path.read_text(encoding="utf-8"))


@dataclass
class Browser:
    """Chromium without a window; each call is a browser of its own."""

    folder: Path
    calls: int = field(default=0)

    def _run(self, page: Path, look: str, *options: str) -> str:
        self.calls += 1
        profile = f"--user-data-dir={self.folder / f'profile{self.calls}'}"
        command = [str(CHROMIUM), *FLAGS, profile, *options, f"{page.as_uri()}#{look}"]
        environment = {**os.environ, "HOME": str(self.folder)}
        return subprocess.run(
            command, capture_output=True, text=True, timeout=60, env=environment
        ).stdout

    def state(self, page: Path, look: str = "") -> dict[str, Any]:
        """What the page says of itself: attributes of its root, with the points drawn by class."""
        dom = Page(self._run(page, look, "--dump-dom"))
        root = next(attributes for tag, attributes in dom.elements if tag == "html")
        drawn = json.loads(root.get("data-drawn") or "null")
        return {**root, "drawn": drawn, "title": dom.texts.get("<title>"), "dom": dom}

    def picture(self, page: Path, look: str = "") -> np.ndarray:
        """(H, W, 3) 0..255 of the part of the window that holds nothing but points."""
        path = self.folder / "picture.png"
        self._run(page, look, f"--screenshot={path}")
        image = (imread(path)[..., :3] * 255).round().astype(int)
        return np.asarray(image[:, 300:740])


def places(image: np.ndarray, color: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the pixels that have a colour."""
    rows, columns = np.nonzero(np.abs(image - np.asarray(color)).max(axis=-1) <= 3)
    return rows, columns


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Browser:
    if CHROMIUM is None:
        pytest.skip("no Chromium here")
    return Browser(tmp_path_factory.mktemp("chromium"))
