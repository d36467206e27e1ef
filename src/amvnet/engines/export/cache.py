"""The cache of exported networks, for the engines of ONNX Runtime.

Its files can be made again, and no other user may write them.
"""

from __future__ import annotations

import os
import shutil
import stat
import uuid
from collections.abc import Sequence
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryFile

import torch

from amvnet.engines.export.int8 import STREETS, simulated_scans
from amvnet.engines.export.onnx import OPSET, check_libraries, export
from amvnet.engines.export.onnx_files import IR_VERSION
from amvnet.engines.onnx import RANGE_NET, UNET, ExportedNetworks
from amvnet.errors import InputError
from amvnet.files import digest, make_folder, temporary_folder, unfinished
from amvnet.models.methods import widest_method
from amvnet.onnx_runner import read_description, read_graph
from amvnet.progress import Reporter, report_nothing
from amvnet.scan import Scan
from amvnet.weights.file import Weights

CACHE = "AMVNET_CACHE"  # the environment variable that names the folder of the cache
PRIVATE_FOLDER = 0o700  # mode of a folder that only this user may use
PRIVATE_FILE = 0o600  # mode of a file that only this user may use
RENAME_ATTEMPTS = 10  # attempts to give a folder its name while other processes do the same


def cached_networks(
    weights: Weights, int8: bool = False, report: Reporter = report_nothing
) -> ExportedNetworks:
    """Return the graphs of some weights from the cache; export them if the cache lacks them.

    The files are compared with the digests in their description. If a file differs or is missing,
    the networks are exported again. A cache that another user can write is not used, and a cache
    that cannot be written is not filled: the networks are exported for this process alone. Several
    processes may use the cache at the same time.

    Raises:
        InputError: if `export` or `simulated_scans` raises it.
    """
    check_libraries()
    exported = "exported and calibrated in int8" if int8 else "exported"
    folder = user_cache() / "onnx" / _key(weights, int8)
    shared = shared_with_others(folder)
    if shared is not None:
        problem = f"{shared}: expected a cache that no other user can write, found that others can"
    else:
        with suppress(InputError):
            return ExportedNetworks(_read(folder, weights), folder)
        place = f"{folder.parent}: expected a cache to write to, found a place that is read-only"
        problem = "" if _can_write(folder.parent) else place

    if problem:
        report(
            f"{problem}; the networks are {exported} for this run alone; correct its owner and "
            f"mode, or set {CACHE} to a folder of yours"
        )
    else:
        found = ", because files in the cache were missing or changed" if folder.exists() else ""
        report(f"the networks are {exported}{found}, once for these weights, and kept in {folder}")

    scans = simulated_scans(weights) if int8 else []
    if not problem:
        return ExportedNetworks(_export(weights, scans, folder), folder)
    with temporary_folder() as temporary:
        export(weights, temporary, scans=scans)
        return ExportedNetworks(_read(temporary, weights))


def _key(weights: Weights, int8: bool) -> str:
    """Return the name of the folder of an export."""
    digests = [weights.digest(part) for part in weights.parts]
    key = [*digests, repr(weights.model), version("amvnet"), torch.__version__]
    if int8:
        key.append(f"int8 {STREETS}")
    return digest(repr((key, OPSET, IR_VERSION)))


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


def _export(weights: Weights, scans: Sequence[Scan], folder: Path) -> dict[str, bytes]:
    """Export into a folder of the cache, which appears whole; return the contents of the graphs."""
    part = folder.with_name(f".{uuid.uuid4().hex}.part")
    part.mkdir(PRIVATE_FOLDER)
    unfinished.add(part)
    try:
        export(weights, part, scans=scans)
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


def user_cache() -> Path:
    """Return the folder of the cache: $AMVNET_CACHE, or else `amvnet` in the user's cache."""
    if os.environ.get(CACHE):
        return Path(os.environ[CACHE])
    caches = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(caches) / "amvnet"


def make_private(folder: Path) -> None:
    """Make a folder of the cache, and the folders above it, for this user alone.

    Raises:
        InputError: if a folder cannot be made.
    """
    for path in reversed([folder, *folder.parents]):
        try:
            path.mkdir(PRIVATE_FOLDER, exist_ok=True)
        except OSError:
            make_folder(path)  # raises an error that explains what is wrong


def shared_with_others(folder: Path) -> Path | None:
    """Return a file or folder of the cache that another user can write or replace, or None.

    The administrator of the system does not count as another user.
    """
    if not hasattr(os, "getuid"):  # the modes of files on Windows say nothing
        return None

    root = user_cache()
    files = list(folder.iterdir()) if folder.is_dir() else []
    for path in (*files, folder, folder.parent, root, root.resolve()):
        if path.exists() and not (_is_own(path.stat()) and _is_own(path.lstat())):
            return path
    # A user who can rename a folder can put another folder in its place. In a sticky one, such as
    # /tmp, only owners can.
    for path in (*root.absolute().parents, *root.resolve().parents):
        is_sticky = path.exists() and path.stat().st_mode & stat.S_ISVTX
        if path.exists() and _can_others_write(path.stat()) and not is_sticky:
            return path
    return None


def _is_own(status: os.stat_result) -> bool:
    """Return whether only this user or the administrator owns a file and can write it."""
    if status.st_uid not in (0, os.getuid()):
        return False
    return stat.S_ISLNK(status.st_mode) or not _can_others_write(status)


def _can_others_write(status: os.stat_result) -> bool:
    """Return whether the mode of a file lets users other than its owner write."""
    by_group = status.st_mode & stat.S_IWGRP and not _is_group_of_one(status.st_gid)
    return bool(status.st_mode & stat.S_IWOTH or by_group)


def _is_group_of_one(gid: int) -> bool:
    """Return whether this user is the only member of a group, as on systems with private groups."""
    import grp
    import pwd

    try:
        user = pwd.getpwuid(os.getuid())
        group = grp.getgrgid(gid)
    except KeyError:
        return False
    names = {group.gr_name, *group.gr_mem}
    return gid == user.pw_gid and names == {user.pw_name}
