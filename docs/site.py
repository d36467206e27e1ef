"""Let MkDocs add the address of the repository, and a page that shows a scan in 3D."""

from __future__ import annotations

import io
import tomllib
from contextlib import redirect_stdout
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import amvnet
from amvnet.cli.commands.demo import SEED
from amvnet.cli.main import DONE, main

ROOT = Path(__file__).parents[1]
LIVE = "live/index.html"  # the page of the scan, which docs/index.md shows


def on_config(config: Any, **_: Any) -> Any:
    """Take the address of the repository from pyproject.toml; MkDocs calls this first."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    config.repo_url = project["urls"]["Repository"]
    config.repo_name = project["name"]
    return config


def on_post_build(config: Any, **_: Any) -> None:
    """Write the page of a simulated scan into the site; MkDocs calls this last."""
    page = Path(config.site_dir) / LIVE
    with TemporaryDirectory() as folder:
        data = amvnet.simulate(Path(folder) / "street", sequences=1, scans=2, seed=SEED)
        view = ["view", str(data), "--weights", "sim-hdl64e", "--html", str(page), "--overwrite"]
        with redirect_stdout(io.StringIO()):
            code = main(view)
    if code != DONE:
        raise RuntimeError(f"expected `amvnet view` to write {page}, found exit code {code}")
