"""Let MkDocs add the address of the repository, and a page that shows a scan in 3D.

The site asks no other host for anything, and commands break between their options.
"""

from __future__ import annotations

import io
import re
import tomllib
from contextlib import redirect_stdout
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import amvnet
from amvnet.cli.commands.demo import SEED
from amvnet.cli.main import DONE, main

ROOT = Path(__file__).parents[1]
# An option of a command in the text of a page, such as --weights.
OPTION = re.compile(r"(?<![\w\"'#/=-])--[a-z][\w.-]*")
LIVE = "live/index.html"  # the page of the scan, which docs/index.md shows


def on_config(config: Any, **_: Any) -> Any:
    """Take the address of the repository from pyproject.toml; MkDocs calls this first."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    config.repo_url = project["urls"]["Repository"]
    config.repo_name = project["name"]
    return config


def on_page_content(html: str, **_: Any) -> str:
    """Keep each option on one line, because browsers break lines after hyphens."""
    return OPTION.sub(r'<span class="option">\g<0></span>', html)


def on_post_page(output: str, **_: Any) -> str:
    """Leave out what makes Material for MkDocs ask api.github.com for the repository's stars."""
    return output.replace(' data-md-component="source"', "")


def on_post_build(config: Any, **_: Any) -> None:
    """Write the page of a simulated scan into the site; MkDocs calls this last."""
    print(f"labelling a simulated scan for {LIVE}")
    page = Path(config.site_dir) / LIVE
    with TemporaryDirectory() as folder:
        data = amvnet.simulate(Path(folder) / "street", sequences=1, scans=2, seed=SEED)
        view = ["view", str(data), "--weights", "sim-hdl64e", "--html", str(page), "--overwrite"]
        with redirect_stdout(io.StringIO()):
            code = main(view)
    if code != DONE:
        raise RuntimeError(f"expected `amvnet view` to write {page}, found exit code {code}")
