"""One scan in a file packed by gzip or zip: it is unpacked into a temporary folder."""

from __future__ import annotations

import gzip
import shutil
import zipfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import IO, cast

from amvnet.data.formats.cloud import reading
from amvnet.data.formats.detect import PACKED
from amvnet.errors import InputError

ADVICE = "unpack the file, and give the scans"


@contextmanager
def unpacked(path: Path) -> Iterator[Path]:
    """Yield the path of the unpacked file.

    Call this in the process with limits, which bound the unpacked file, too. An InputError of the
    block gets the name of the packed file.

    Raises:
        InputError: if the file is broken, or holds no or several files.
    """
    with TemporaryDirectory() as folder, ExitStack() as stack:
        with reading(path, "a scan packed by gzip or zip", ADVICE):
            name, packed = _open(path, stack)
            inner = Path(folder) / name
            with inner.open("wb") as file:
                shutil.copyfileobj(packed, file)
        try:
            yield inner
        except InputError as error:
            raise InputError(str(error).replace(str(inner), str(path))) from None


def _open(path: Path, stack: ExitStack) -> tuple[str, IO[bytes]]:
    """Return the name of the packed file, and the file to read it from."""
    if not zipfile.is_zipfile(path):
        named = path.name.lower().endswith(PACKED)
        file = cast("IO[bytes]", stack.enter_context(gzip.GzipFile(path)))
        return path.stem if named else path.name, file

    archive = stack.enter_context(zipfile.ZipFile(path))
    members = [member for member in archive.infolist() if not member.is_dir()]
    if len(members) != 1:
        raise InputError(f"{path}: expected one scan, found {len(members)} files; {ADVICE}")
    return PurePosixPath(members[0].filename).name, stack.enter_context(archive.open(members[0]))
