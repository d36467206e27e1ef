"""The cache of exported networks, for the engines of ONNX Runtime."""

from __future__ import annotations

import hashlib
import os
import shutil
import stat
import uuid
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from amvnet.engines.onnx import RANGE_NET, UNET, ExportedNetworks
from amvnet.errors import InputError
from amvnet.export.onnx import OPSET, check_libraries, export
from amvnet.files import make_folder, unfinished
from amvnet.models.methods import widest_method
from amvnet.onnx_runner import read_description, read_graph
from amvnet.progress import Say, say_nothing
from amvnet.weights.file import Weights

CACHE = "AMVNET_CACHE"  # the environment variable with the cache's folder
PRIVATE_FOLDER = 0o700
PRIVATE_FILE = 0o600
ATTEMPTS = 10  # to give a folder its name while other processes do the same


def cache_folder() -> Path:
    """Return where exported networks are kept: $AMVNET_CACHE, or amvnet in the user's cache."""
    if os.environ.get(CACHE):
        return Path(os.environ[CACHE])

    caches = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(caches) / "amvnet"


def cached_networks(
    weights: Weights, int8: str | None = None, say: Say = say_nothing
) -> ExportedNetworks:
    """Return the graphs of some weights from the cache; export them if the cache lacks them.

    The files are compared with the digests in their description. If one differs or is missing, the
    networks are exported again. A cache that another user can write is not used: the networks are
    exported for this process alone. Several processes may use the cache at the same time.

    Args:
        int8: as `export` takes it.
        say: called with a line before work that takes long.

    Raises:
        InputError: as `export`.
    """
    check_libraries()
    exported = "exported" if int8 is None else "exported and calibrated in int8"
    folder = cache_folder() / "onnx" / _key(weights, int8)
    shared = _shared_with_others(folder)
    if shared is not None:
        say(
            f"{shared}: expected a cache that no other user can write, found one that others can; "
            f"the networks are {exported} for this run alone; correct its owner and mode, or set "
            f"{CACHE} to a folder of yours"
        )
        with TemporaryDirectory() as temporary:
            export(weights, temporary, int8=int8)
            return ExportedNetworks(_read(Path(temporary), weights))

    with suppress(InputError):
        return ExportedNetworks(_read(folder, weights), folder)
    found = "" if not folder.exists() else ", because files in the cache were missing or changed"
    say(f"the networks are {exported}{found}, once for these weights; kept in {folder}")
    return ExportedNetworks(_export(weights, int8, folder), folder)


def _key(weights: Weights, int8: str | None) -> str:
    """Return the name of the folder of an export."""
    digests = [weights.digest(part) for part in weights.parts]
    key = [*digests, repr(weights.model), version("amvnet"), torch.__version__]
    if int8 is not None:
        key.append(f"int8 {int8}")
    return hashlib.sha256(repr((key, OPSET)).encode()).hexdigest()[:16]


def _read(folder: Path, weights: Weights) -> dict[str, bytes]:
    """Return the contents of the graphs of the networks; raise InputError if they are not whole."""
    description = read_description(folder)
    if description["method"] != widest_method(weights.parts):
        raise InputError(f"{folder}: expected the graphs of these weights, found others")

    graphs = description["graphs"]
    return {name: read_graph(folder, graphs[name]) for name in (RANGE_NET, UNET) if name in graphs}


def _export(weights: Weights, int8: str | None, folder: Path) -> dict[str, bytes]:
    """Export into a folder of the cache, which appears whole; return what was exported."""
    _make_private(folder.parent)
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
    """Give a finished folder its name, unless another process has exported the same.

    A folder of that name with other files is replaced. If the export fails, the cache does
    not change.
    """
    for _ in range(ATTEMPTS):
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


def _make_private(folder: Path) -> None:
    """Make a folder of the cache, and those above it, for this user alone."""
    for path in reversed([folder, *folder.parents]):
        try:
            path.mkdir(PRIVATE_FOLDER, exist_ok=True)
        except OSError:
            make_folder(path)  # explains what is wrong


# ---- who can write


def _shared_with_others(folder: Path) -> Path | None:
    """Return what another user can write or replace of a folder of the cache; None if nothing.

    The system's administrator is not another user.
    """
    if not hasattr(os, "getuid"):  # the modes of files on Windows say nothing
        return None

    root = cache_folder()
    files = list(folder.iterdir()) if folder.is_dir() else []
    for path in (*files, folder, folder.parent, root, root.resolve()):
        if path.exists() and not (_is_own(path.stat()) and _is_own(path.lstat())):
            return path
    # Whoever can rename a folder can put another one in its place.
    for path in (*root.absolute().parents, *root.resolve().parents):
        if path.exists() and _can_others_write(path.stat()) and not _is_sticky(path.stat()):
            return path
    return None


def _is_own(status: os.stat_result) -> bool:
    """Return whether a file belongs to this user or the administrator, and only they can write."""
    if status.st_uid not in (0, os.getuid()):
        return False
    return stat.S_ISLNK(status.st_mode) or not _can_others_write(status)


def _can_others_write(status: os.stat_result) -> bool:
    """Return whether the mode lets others than the owner write."""
    by_group = status.st_mode & stat.S_IWGRP and not _is_group_of_one(status.st_gid)
    return bool(status.st_mode & stat.S_IWOTH or by_group)


def _is_sticky(status: os.stat_result) -> bool:
    """Return whether only owners can rename what is in a folder, as in /tmp."""
    return bool(status.st_mode & stat.S_ISVTX)


def _is_group_of_one(gid: int) -> bool:
    """Return whether a group is the private one of this user, as some systems make for each."""
    import grp
    import pwd

    try:
        user = pwd.getpwuid(os.getuid())
        group = grp.getgrgid(gid)
    except KeyError:
        return False
    names = {group.gr_name, *group.gr_mem}
    return gid == user.pw_gid and names == {user.pw_name}
