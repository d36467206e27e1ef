"""Write output files that appear whole or not at all, and read YAML files."""

from __future__ import annotations

import errno
import fcntl
import os
import re
import shutil
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import yaml
from yaml.reader import ReaderError

from amvnet.errors import InputError, shown

LARGEST_YAML = 50_000  # largest size of a YAML file, bytes; PyYAML takes a second for it
DEEPEST_YAML = 50  # largest number of levels of nested values in a YAML file
LONGEST_INTEGER = 40  # largest number of digits of a whole number in a YAML file
INTEGER = "tag:yaml.org,2002:int"  # PyYAML's tag of whole numbers
# A pattern that matches the names of files that `atomic_write` has not finished.
UNFINISHED_FILES = f".{'[0-9a-f]' * 32}.part*"
CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]")  # matches characters that file names must not have
# Errors of the system that the user can avoid with the name of another file.
REFUSALS = (errno.EACCES, errno.EPERM, errno.EROFS, errno.EISDIR, errno.ENAMETOOLONG)
LONGEST_NAME = 255  # longest file name in most file systems, bytes
LONGEST_ENDING = 20  # longest ending that an unfinished file keeps, characters

unfinished: set[Path] = set()  # files and folders to remove if the process exits at once


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

    Args:
        parent: the folder in which it is made. By default, it is the system's temporary folder.
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
    """Write a finished file to the disk, and then rename it from `part` to `path`.

    Both paths are in the same file system.
    """
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
        folder: the output folder.
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
        name: the path of the file, relative to the folder.

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
    """Return a token that is to be the name of a file.

    Raises:
        InputError: if it is not a plain name.
    """
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


def read_yaml(path: Path, content: str) -> Any:
    """Return the content of a YAML file: dictionaries, lists, texts and numbers.

    Nothing in the file is executed.

    Args:
        path: the file.
        content: the expected content, for messages, such as "a label map".

    Raises:
        InputError: if the file cannot be read, is too large, or is not YAML.
    """
    expected = f"{path}: expected {content} (YAML)"
    try:
        size = path.stat().st_size
        if size <= LARGEST_YAML:
            return parse_yaml(path.read_text(encoding="utf-8"), expected)
    except OSError as error:
        raise InputError(f"{expected}, found {error.strerror}; check the path") from None
    except UnicodeDecodeError:
        raise InputError(f"{expected}, found text that is not UTF-8; save it as UTF-8") from None
    raise InputError(f"{expected} of at most {LARGEST_YAML} bytes, found {size}; give another file")


def parse_yaml(text: str, expected: str) -> Any:
    """Return the value of a YAML text. Nothing in it is executed.

    Args:
        text: the text.
        expected: the beginning of error messages.

    Raises:
        InputError: if the text is not YAML, has aliases or is nested deeply.
    """
    try:
        return yaml.load(text, _BoundedLoader)
    except (yaml.YAMLError, ValueError) as error:  # ValueError: numbers and dates
        raise InputError(f"{expected}, found {_fault_of_yaml(error, text)}; correct it") from None


def _fault_of_yaml(error: Exception, text: str) -> str:
    """Return in a few words what is wrong in a YAML text, and in which of its lines."""
    if isinstance(error, ReaderError):
        last = text.count("\n", 0, error.position) + 1
        first = last
        reason = f"the character {chr(error.character)!r}"
    elif isinstance(error, yaml.MarkedYAMLError) and error.problem_mark is not None:
        last = error.problem_mark.line + 1
        first = last if error.context_mark is None else error.context_mark.line + 1
        reason = (error.problem or "no YAML").replace("'<stream end>'", "the end")
    else:
        return " ".join(str(error).split())[:300]

    if "\n" not in text:
        return f"a mistake ({reason})"
    place = f"line {last}" if first == last else f"lines {first} to {last}"
    return f"a mistake in {place} ({reason})"


class _BoundedLoader(yaml.SafeLoader):
    """PyYAML's safe loader without features that can take hours or unlimited memory.

    The depth of values and the length of numbers are limited. Aliases are refused, because ten
    lines with aliases can stand for billions of values. A key may not occur twice, because one of
    its values would be lost.
    """

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self._depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            alias = self.peek_event()  # type: ignore[no-untyped-call]
            raise yaml.YAMLError(f"the alias *{alias.anchor[:50]}, write its value out")
        if self._depth == DEEPEST_YAML:
            raise yaml.YAMLError(f"more than {DEEPEST_YAML} levels")
        self._depth += 1
        node = super().compose_node(parent, index)
        self._depth -= 1

        return node

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        # Call PyYAML first, because it checks the kinds of the nodes.
        mapping = super().construct_mapping(node, deep)
        keys = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if key in keys:
                raise yaml.YAMLError(f"the key {shown(key)} twice")
            keys.add(key)
        return mapping

    def construct_scalar(self, node: Any) -> Any:
        if node.tag == INTEGER and len(node.value) > LONGEST_INTEGER:
            raise yaml.YAMLError(f"a number of {len(node.value)} digits")
        return super().construct_scalar(node)
