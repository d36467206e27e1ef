"""The user's cache: files that can be made again, which no other user may write."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from amvnet.files import make_folder

CACHE = "AMVNET_CACHE"  # environment variable: the folder of the cache
PRIVATE_FOLDER = 0o700
PRIVATE_FILE = 0o600


def user_cache() -> Path:
    """Return the folder for files that can be made again.

    It is $AMVNET_CACHE, or else amvnet in the user's cache.
    """
    if os.environ.get(CACHE):
        return Path(os.environ[CACHE])
    caches = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(caches) / "amvnet"


def make_private(folder: Path) -> None:
    """Make a folder of the cache, and those above it, for this user alone."""
    for path in reversed([folder, *folder.parents]):
        try:
            path.mkdir(PRIVATE_FOLDER, exist_ok=True)
        except OSError:
            make_folder(path)  # explains what is wrong


def shared_with_others(folder: Path) -> Path | None:
    """Return what another user can write or replace of a folder of the cache; None if nothing.

    The system's administrator is not another user.
    """
    if not hasattr(os, "getuid"):  # the modes of files on Windows say nothing
        return None

    root = user_cache()
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
