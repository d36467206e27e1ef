"""Read and write files and folders by their URL, such as s3://bucket/drive, or by their path."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pyarrow as pa
from pyarrow import fs

from amvnet.errors import InputError, reason_of
from amvnet.files import atomic_write
from amvnet.fleet.secrets import CREDENTIALS, without_secrets

# Options in the URL of a storage, by its scheme. Without this one, pyarrow uploads even a small
# file in three requests.
URL_OPTIONS = {"s3": "?allow_delayed_open=true"}


@dataclass(frozen=True)
class Place:
    """A file or a folder on this machine or in object storage; it need not exist.

    Attributes:
        address: the URL that the user wrote, which may hold credentials; or an absolute path.
    """

    address: str
    filesystem: fs.FileSystem
    path: str

    @classmethod
    def of(cls, url: str) -> Place:
        """Return the place of a URL or a path.

        Raises:
            InputError: if there is no such storage, or its package is not installed.
        """
        scheme, is_url, rest = url.partition("://")
        if not is_url:
            path = str(Path(os.path.expanduser(url)).absolute())
            return cls(path, fs.LocalFileSystem(), path)

        bucket, slash, path = rest.rstrip("/").partition("/")
        if "@" not in bucket and CREDENTIALS.search(url):
            raise InputError(
                f"{without_secrets(url)}: expected a password with %2F in place of /, found a "
                "password with /; escape it"
            )
        filesystem, root = _open(scheme, bucket)
        return cls(url.rstrip("/"), filesystem, f"{root.rstrip('/')}{slash}{path}")

    def __truediv__(self, name: str) -> Place:
        return Place(f"{self.address}/{name}", self.filesystem, f"{self.path}/{name}")

    @property
    def url(self) -> str:
        """The address without credentials, to show and to store."""
        return without_secrets(self.address)

    @property
    def local(self) -> Path | None:
        """The path of a place on this machine; None for a place in object storage."""
        return Path(self.path) if isinstance(self.filesystem, fs.LocalFileSystem) else None

    def is_in(self, folder: Place) -> bool:
        """Return whether the place is a folder or lies in it, also through symbolic links."""
        if self.filesystem.type_name != folder.filesystem.type_name:
            return False
        paths = {(self.path, folder.path)}
        if isinstance(self.filesystem, fs.LocalFileSystem):
            paths = {
                (spell(self.path), spell(folder.path))
                for spell in (os.path.abspath, os.path.realpath)
            }
        return any(f"{path}/".startswith(f"{parent.rstrip('/')}/") for path, parent in paths)

    def kind(self) -> fs.FileType:
        """Return whether the place is a file, a folder or nothing.

        Raises:
            InputError: if the storage cannot be reached.
        """
        with reaching(self.url):
            return self.filesystem.get_file_info(self.path).type

    def children(self) -> tuple[list[str], list[str]]:
        """Return the sorted names of the files in a folder, and the sorted names of its folders.

        Raises:
            InputError: if the folder cannot be listed.
        """
        files: list[str] = []
        folders: list[str] = []
        with reaching(self.url):
            for info in self.filesystem.get_file_info(fs.FileSelector(self.path)):
                names = folders if info.type == fs.FileType.Directory else files
                names.append(info.base_name)
        return sorted(files), sorted(folders)

    def walk(self, prefix: str = "") -> Iterator[tuple[str, Place, list[str]]]:
        """Yield the folder and all folders below it that are not hidden, with their files.

        Yields:
            `prefix` and the path of a folder relative to this one, such as "drive/"; the folder;
            and the sorted names of its files.

        Raises:
            InputError: if a folder cannot be listed.
        """
        files, folders = self.children()
        yield prefix, self, files
        for name in folders:
            if not name.startswith("."):
                yield from (self / name).walk(f"{prefix}{name}/")

    def fetch(self, folder: Path) -> Path:
        """Return the path of a file on this machine, or of its copy in a folder, which is made.

        Raises:
            InputError: if the file cannot be read.
        """
        if self.local is not None:
            return self.local
        copy = folder / Path(self.path).name
        folder.mkdir(parents=True, exist_ok=True)
        copy.write_bytes(self.read())
        return copy

    def read(self) -> bytes:
        """Return the content of a file; raise InputError if it cannot be read."""
        with reaching(self.url), self.filesystem.open_input_stream(self.path) as stream:
            return bytes(stream.read())

    def write(self, content: bytes) -> None:
        """Write a file; it appears whole or not at all.

        Raises:
            InputError: if the file is on this machine and cannot be written.
            OSError: if there is no space, or the storage does not take the file.
        """
        if self.local is not None:
            with atomic_write(self.local) as part:
                part.write_bytes(content)
            return
        try:
            with self.filesystem.open_output_stream(self.path) as stream:
                stream.write(content)
        except OSError as error:
            raise OSError(errno.EIO, _reason_of(error), self.url) from None

    def remove(self) -> None:
        """Remove a file."""
        self.filesystem.delete_file(self.path)


@contextmanager
def reaching(url: str) -> Iterator[None]:
    """Turn errors of the storage in this block into an `InputError` of one line."""
    try:
        yield
    except (OSError, pa.ArrowException) as error:
        raise InputError(
            f"{url}: expected a file or a folder that can be read, found {_reason_of(error)}; "
            "check the URL and the credentials"
        ) from None


@cache
def _open(scheme: str, bucket: str) -> tuple[fs.FileSystem, str]:
    """Return the filesystem of a bucket and the path of the bucket in it.

    pyarrow opens some storages itself, and all others through fsspec.
    """
    root = f"{scheme}://{bucket}"
    shown_root = without_secrets(root)
    with reaching(shown_root), suppress(pa.ArrowInvalid):  # not a scheme of pyarrow
        uri = f"{root}{URL_OPTIONS.get(scheme, '/')}"
        opened: tuple[fs.FileSystem, str] = fs.FileSystem.from_uri(uri)
        return opened
    try:
        opened = fs.FileSystem.from_uri(f"fsspec+{root}")
    except (ImportError, ValueError) as error:
        raise InputError(
            f"{shown_root}: expected a storage that can be opened, found {_reason_of(error)}; "
            "install its package, or use s3://, gs:// or file://"
        ) from None
    return opened


def _reason_of(error: BaseException) -> str:
    """Return the reason of an error, without the number of the request."""
    return without_secrets(reason_of(error)).partition(" (Request ID")[0]
