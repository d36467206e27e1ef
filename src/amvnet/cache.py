"""Make and check the user's cache: files that can be made again, which no other user may write."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from amvnet.files import make_folder

CACHE = "AMVNET_CACHE"  # the environment variable that names the folder of the cache
PRIVATE_FOLDER = 0o700  # mode of a folder that only this user may use
PRIVATE_FILE = 0o600  # mode of a file that only this user may use


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
    # A user who can rename a folder can put another folder in its place.
    for path in (*root.absolute().parents, *root.resolve().parents):
        if path.exists() and _can_others_write(path.stat()) and not _is_sticky(path.stat()):
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


def _is_sticky(status: os.stat_result) -> bool:
    """Return whether only owners can rename files in a folder, as in /tmp."""
    return bool(status.st_mode & stat.S_ISVTX)


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
