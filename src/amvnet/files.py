"""Check which files a command may write, and write them whole or not at all.

A command writes no file that it reads, and replaces only files of its own kind.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import os
import re
import shutil
import stat
import tempfile
import uuid
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Literal

from amvnet.errors import InputError, shown

# A pattern that matches the names of files that `atomic_write` has not finished.
UNFINISHED_FILES = f".{'[0-9a-f]' * 32}.part*"
CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]")  # matches characters that file names must not have
# Errors of the system that the user can avoid with the name of another file.
REFUSALS = (errno.EACCES, errno.EPERM, errno.EROFS, errno.EISDIR, errno.ENAMETOOLONG)
LONGEST_NAME = 255  # longest file name in most file systems, bytes
LONGEST_ENDING = 20  # longest ending that an unfinished file keeps, characters
HEAD = 4096  # length of the beginning of a file that is compared with a signature, bytes

# The format of the labels of a scan file.
FormatName = Literal["label", "npy", "csv", "ply", "pcd", "las", "laz"]

unfinished: set[Path] = set()  # files and folders to remove if the process exits at once


def digest(content: str | Iterable[bytes]) -> str:
    """Return 16 hexadecimal digits that identify a text, or bytes in one or several pieces."""
    sha = hashlib.sha256()
    for piece in [content.encode()] if isinstance(content, str) else content:
        sha.update(piece)
    return sha.hexdigest()[:16]


def size_and_time(path: Path) -> tuple[int, int]:
    """Return the bytes of a file or of a folder's files, and their last change in nanoseconds.

    Both are 0 if nothing has this name.
    """
    try:
        found = [file.stat() for file in (path.iterdir() if path.is_dir() else [path])]
    except OSError:
        found = []
    times = (status.st_mtime_ns for status in found)
    return sum(status.st_size for status in found), max(times, default=0)


def write_json(path: Path, value: Any) -> None:
    """Write a value as JSON, whole or not at all."""
    with atomic_write(path) as part:
        part.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")


def write_yaml(path: Path, entries: Mapping[str, Any]) -> None:
    """Write entries as YAML, in their order, whole or not at all."""
    import yaml

    with atomic_write(path) as part:
        part.write_text(yaml.safe_dump(entries, sort_keys=False, width=1000))


@contextmanager
def atomic_write(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path to write to, and rename it to `path` if the block succeeds.

    The temporary file lies in the same folder, which is made if necessary, and has the same ending.
    It is removed if the block raises. The mode of the file follows the umask, even if a library
    writes private files.

    The content is on the disk before the file has its name. After a power cut, there is either the
    whole old file or the whole new file. Some file systems do not write folders on request, so that
    a power cut may lose the last files. It may also lose content that is written without this
    function, such as the last lines of a journal.

    If the name of the file is made from data, join it to the folder with `inside`.

    Raises:
        InputError: if the folder cannot be made or the file cannot be written.
    """
    path = Path(path)
    make_folder(path.parent)
    ending = path.suffix if len(path.suffix) <= LONGEST_ENDING else ""
    part = path.with_name(f".{uuid.uuid4().hex}.part{ending}")

    unfinished.add(part)
    try:
        part.touch()
        mode = part.stat().st_mode
        yield part
        if part.stat().st_mode != mode:
            part.chmod(mode)

        publish(part, path)
    except OSError as error:
        if error.errno in REFUSALS:
            raise InputError(
                f"{path}: expected a file that can be written, found {error.strerror}; give another"
            ) from None

        if error.filename == str(part):
            error.filename = str(path)
        if error.filename is None:  # an error of a write, or NumPy's error, which has no number
            text = error.strerror or str(error)
            raise OSError(error.errno or errno.EIO, text, str(path)) from None
        raise
    finally:
        with suppress(OSError):  # the file system may be read-only
            part.unlink(missing_ok=True)
        unfinished.discard(part)


@contextmanager
def temporary_folder(parent: Path | None = None) -> Iterator[Path]:
    """Yield a new folder, which is removed at the end, even if the process exits at once.

    It is made in the folder `parent`, by default the system's temporary folder.
    """
    if parent is None:
        folder = Path(tempfile.gettempdir()) / f"amvnet-{uuid.uuid4().hex}"
    else:
        folder = parent / f".{uuid.uuid4().hex}.part"

    unfinished.add(folder)  # before the folder is made, because the process may exit at any time
    try:
        if parent is None:
            folder.mkdir(0o700)
        else:
            make_folder(folder)
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        unfinished.discard(folder)


def publish(part: Path, path: Path) -> None:
    """Write a finished file to the disk, and rename it to `path` in the same file system."""
    with part.open("rb+") as file:
        os.fsync(file.fileno())
    os.replace(part, path)
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        with suppress(OSError):  # some network file systems refuse it
            os.fsync(folder)
    finally:
        os.close(folder)


@contextmanager
def alone_in(folder: Path, lock: str = ".lock") -> Iterator[None]:
    """Keep other runs out of an output folder during the block. The folder is made if necessary.

    The lock ends with the process, however it ends. A folder that was made is removed if the block
    leaves it empty.

    Args:
        lock: the name of the file that is locked, which exists only during the block.

    Raises:
        InputError: if another run has the lock, or the folder cannot be written to.
    """
    is_new = not folder.exists()
    make_folder(folder)
    path = folder / lock
    file = _open_locked(path)
    try:
        yield
    finally:
        path.unlink(missing_ok=True)
        file.close()
        if is_new:
            with suppress(OSError):  # the folder is empty only if an error was found
                folder.rmdir()


def _open_locked(path: Path) -> IO[str]:
    while True:
        try:
            file = path.open("a")
        except OSError as error:
            if error.errno not in REFUSALS:
                raise
            raise InputError(
                f"{path.parent}: expected a folder to write to, found {error.strerror}; give "
                "another"
            ) from None

        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.close()
            raise InputError(
                f"{path.parent}: expected a folder for this run alone, found another run that is "
                "writing into it; wait until it ends, or change --out"
            ) from None
        except OSError:
            return file  # some network file systems have no locks

        # The run that had the lock may have removed the file after it was opened here.
        if path.exists() and path.stat().st_ino == os.fstat(file.fileno()).st_ino:
            return file
        file.close()


def remove_unfinished(folder: Path) -> None:
    """Remove what killed runs have not finished: files, also in folders inside, and folders."""
    for path in folder.rglob(UNFINISHED_FILES):
        if path.is_file():
            path.unlink(missing_ok=True)
    for path in folder.glob(UNFINISHED_FILES):
        shutil.rmtree(path, ignore_errors=True)


def inside(folder: Path | str, name: Path | str) -> Path:
    """Return the path of an output file whose name is made from data, such as a token of a table.

    Call this immediately before a file is written, because links may appear on the disk.

    Args:
        folder: the output folder, which may itself be a link.

    Raises:
        InputError: if the file would lie outside the folder because its name is absolute, has `..`
            or leads through a link; or if its name has control characters or is too long.
    """
    folder = Path(folder)
    name = Path(name)
    fault = fault_of_name(name)
    if fault is not None:
        raise InputError(
            f"{folder}: expected names of output files inside it, found {fault} in "
            f"{shown(str(name))}; rename the scan"
        )

    for parent in list(name.parents)[:-1]:
        _refuse_link(folder / parent)
    return folder / name


def check_no_links(folder: Path) -> None:
    """Check that no folder inside an output folder is a link.

    Call this before another library writes into the folder.

    Raises:
        InputError: if there is such a link.
    """
    for pattern in ("*", "*/*", "*/*/*"):
        for path in folder.glob(pattern):
            if path.is_dir():
                _refuse_link(path)


def _refuse_link(path: Path) -> None:
    if path.is_symlink():
        raise InputError(
            f"{path}: expected a folder for output files, found a link; remove it or change --out"
        )


def fault_of_name(name: Path) -> str | None:
    """Return the fault of an output file's name, which is relative to its folder, or None."""
    if name.anchor or ".." in name.parts or not name.name:
        return "a path that leads elsewhere"
    if CONTROL.search(str(name)):
        return "control characters"
    try:
        longest = max(len(os.fsencode(part)) for part in name.parts)
    except UnicodeEncodeError:
        return "characters that no file name can have"

    return f"more than {LONGEST_NAME} bytes" if longest > LONGEST_NAME else None


def checked_token(text: object) -> str:
    """Return a token that is to be the name of a file; raise InputError if it is no plain name."""
    if (
        not isinstance(text, str)
        or not text.isprintable()
        or text in ("", ".", "..")
        or set(text) & set("/\\")
    ):
        raise InputError(
            "expected tokens without separators and control characters, "
            f"found {shown(text)}; correct the table"
        )

    return text


def make_folder(path: Path) -> None:
    """Make a folder and its parents; raise InputError if it cannot be made."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        problem = "a file" if isinstance(error, FileExistsError) else error.strerror
        raise InputError(
            f"{path}: expected a folder to write to, found {problem}; give another"
        ) from None


@dataclass(frozen=True)
class Signature:
    """The beginning of all files of one kind.

    Attributes:
        beginning: a regular expression that matches the beginning of each such file.
        unit: a size in bytes. The size of each such file is a multiple of it.
    """

    name: str
    beginning: bytes
    unit: int = 1

    def matches(self, path: Path) -> bool:
        """Return whether a file may be of this kind. An empty file may be of any kind.

        Raises:
            InputError: if the file cannot be read.
        """
        try:
            with path.open("rb") as file:
                head = file.read(HEAD)
        except OSError as error:
            raise InputError(
                f"{path}: expected {self.name} to replace, found a file that cannot be read "
                f"({error.strerror}); write to another place, or remove it"
            ) from None
        if not head:
            return True
        is_whole = path.stat().st_size % self.unit == 0
        return is_whole and re.match(self.beginning, head, re.DOTALL) is not None


def check_outputs(
    outputs: Mapping[Path, Signature],
    inputs: Iterable[Path | str | None] = (),
    overwrite: bool = False,
) -> None:
    """Check that a command may write some files. Call this before the work.

    A command may not write a file that it reads, under any name or link. It may replace a file only
    if the user allows it, and only by a file of the same kind. This function also checks that the
    folders of the files can be written to, so that no time is wasted on results without a place.

    Args:
        outputs: the files, each with the kind that it must have if it exists.
        inputs: files that the command reads. Entries that name no file are ignored.

    Raises:
        InputError: if one of the files may not be written.
    """
    for path in outputs:
        if len(os.fsencode(path.name)) > LONGEST_NAME:
            raise InputError(
                f"{path.parent}: expected a file name of at most {LONGEST_NAME} bytes, found "
                f"{path.name[:20]}... of {len(os.fsencode(path.name))}; give a shorter one"
            )
    existing = [path for path in outputs if os.path.lexists(path)]
    check_not_read(existing, inputs)
    for folder in {path.parent for path in outputs}:
        _check_writable(folder)
    for path in existing:
        found = _no_file(path)
        if found is not None:
            raise InputError(
                f"{path}: expected a file to write, found {found}; give the name of a file"
            )

    if existing and not overwrite:
        more = f" (and {len(existing) - 1} more)" if len(existing) > 1 else ""
        raise InputError(
            f"{existing[0]}{more}: expected no file, found one; write to another place, or say "
            "--overwrite to replace it"
        )
    for path in existing:
        if path.exists() and not outputs[path].matches(path):
            raise InputError(
                f"{path}: expected {outputs[path].name} to replace, found another file; write to "
                "another place, or remove it"
            )


def check_not_read(outputs: Iterable[Path], inputs: Iterable[Path | str | None]) -> None:
    """Raise InputError if an output is a file that the command reads, under any name or link."""
    existing = [path for path in outputs if os.path.lexists(path)]
    if not existing:
        return

    read = {_identity(source): source for source in inputs if source is not None}
    for path in existing:
        identity = _identity(path)
        if identity is not None and identity in read:
            raise InputError(
                f"{path}: expected an output that is not an input, found the input "
                f"{read[identity]}; write to another place"
            )


def _identity(path: Path | str) -> tuple[int, int] | None:
    """Return the device and the inode of the file that a path leads to; None if it is no file."""
    with suppress(OSError, ValueError):  # nothing has this name
        status = os.stat(path)
        if not stat.S_ISDIR(status.st_mode):
            return status.st_dev, status.st_ino
    return None


def _check_writable(folder: Path) -> None:
    """Raise InputError if a folder, or the first existing folder above it, is read-only."""
    place = folder
    while not os.path.lexists(place) and place != place.parent:
        place = place.parent
    if place.is_dir() and not os.access(place, os.W_OK | os.X_OK):
        raise InputError(
            f"{place}: expected a folder to write to, found one that is read-only for this user; "
            "write to another place"
        )


def _no_file(path: Path) -> str | None:
    """Return in words what a path names if it names neither a file nor a broken link, or None."""
    if path.is_dir():
        return "a folder"
    return None if path.is_file() or path.is_symlink() else "a device"
