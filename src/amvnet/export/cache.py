"""The cache of exported networks, for the engines of ONNX Runtime."""

from __future__ import annotations

import hashlib
import shutil
import uuid
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryFile

import torch

from amvnet.cache import (
    CACHE,
    PRIVATE_FILE,
    PRIVATE_FOLDER,
    make_private,
    shared_with_others,
    user_cache,
)
from amvnet.engines.onnx import RANGE_NET, UNET, ExportedNetworks
from amvnet.errors import InputError
from amvnet.export.onnx import OPSET, check_libraries, export
from amvnet.files import temporary_folder, unfinished
from amvnet.models.methods import widest_method
from amvnet.onnx_runner import read_description, read_graph
from amvnet.progress import Reporter, report_nothing
from amvnet.weights.file import Weights

RENAME_ATTEMPTS = 10  # attempts to give a folder its name while other processes do the same


def cached_networks(
    weights: Weights, int8: str | None = None, report: Reporter = report_nothing
) -> ExportedNetworks:
    """Return the graphs of some weights from the cache; export them if the cache lacks them.

    The files are compared with the digests in their description. If a file differs or is missing,
    the networks are exported again. A cache that another user can write is not used, and a cache
    that cannot be written is not filled: the networks are exported for this process alone. Several
    processes may use the cache at the same time. `export` documents `int8` and the errors.
    """
    check_libraries()
    exported = "exported" if int8 is None else "exported and calibrated in int8"
    folder = user_cache() / "onnx" / _key(weights, int8)
    shared = shared_with_others(folder)
    if shared is None:
        with suppress(InputError):
            return ExportedNetworks(_read(folder, weights), folder)

    problem = None
    if shared is not None:
        problem = f"{shared}: expected a cache that no other user can write, found that others can"
    elif not _can_write(folder.parent):
        problem = f"{folder.parent}: expected a cache to write to, found a place that is read-only"
    if problem is not None:
        report(
            f"{problem}; the networks are {exported} for this run alone; correct its owner and "
            f"mode, or set {CACHE} to a folder of yours"
        )
        with temporary_folder() as temporary:
            export(weights, temporary, int8=int8)
            return ExportedNetworks(_read(temporary, weights))

    found = "" if not folder.exists() else ", because files in the cache were missing or changed"
    report(f"the networks are {exported}{found}, once for these weights, and kept in {folder}")
    return ExportedNetworks(_export(weights, int8, folder), folder)


def _key(weights: Weights, int8: str | None) -> str:
    digests = [weights.digest(part) for part in weights.parts]
    key = [*digests, repr(weights.model), version("amvnet"), torch.__version__]
    if int8 is not None:
        key.append(f"int8 {int8}")
    return hashlib.sha256(repr((key, OPSET)).encode()).hexdigest()[:16]


def _read(folder: Path, weights: Weights) -> dict[str, bytes]:
    """Return the contents of the networks' graphs; raise InputError if a file is not complete."""
    description = read_description(folder)
    if description["method"] != widest_method(weights.parts):
        raise InputError(f"{folder}: expected the graphs of these weights, found others")

    graphs = description["graphs"]
    return {name: read_graph(folder, graphs[name]) for name in (RANGE_NET, UNET) if name in graphs}


def _can_write(folder: Path) -> bool:
    """Return whether files can be made in a folder, which is made if it does not exist."""
    try:
        make_private(folder)
        with TemporaryFile(dir=folder):
            return True
    except (InputError, OSError):
        return False


def _export(weights: Weights, int8: str | None, folder: Path) -> dict[str, bytes]:
    """Export into a folder of the cache, which appears whole; return the contents of the graphs."""
    part = folder.with_name(f".{uuid.uuid4().hex}.part")
    part.mkdir(PRIVATE_FOLDER)
    unfinished.add(part)
    try:
        export(weights, part, int8=int8)
        for path in part.iterdir():
            path.chmod(PRIVATE_FILE)
        networks = _read(part, weights)
        _publish(part, folder, weights)
    finally:
        shutil.rmtree(part, ignore_errors=True)
        unfinished.discard(part)
    return networks


def _publish(part: Path, folder: Path, weights: Weights) -> None:
    """Give a finished folder its name, unless another process has exported the same graphs.

    A folder of that name with other files is replaced.
    """
    for _ in range(RENAME_ATTEMPTS):
        with suppress(OSError):
            part.rename(folder)  # fails if there are files in a folder of that name
            return
        with suppress(InputError):
            _read(folder, weights)
            return

        broken = folder.with_name(f".{uuid.uuid4().hex}.part")
        with suppress(OSError):
            folder.rename(broken)
        if broken.is_dir() and not broken.is_symlink():
            shutil.rmtree(broken, ignore_errors=True)
        else:
            broken.unlink(missing_ok=True)
