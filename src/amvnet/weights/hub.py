"""Download weights from the Hugging Face hub by name; only safetensors files are read."""

from __future__ import annotations

import re
from contextlib import AbstractContextManager
from pathlib import Path

from amvnet.errors import InputError, import_optional, one_line_errors, shown

PREFIX = "hf-hub:"
WEIGHTS_FILE = "model.safetensors"
# An owner, a name, or a part of a revision; it cannot be a path that leads elsewhere.
NAME_PART = re.compile(r"[A-Za-z0-9_](?:[A-Za-z0-9_.-]{0,94}[A-Za-z0-9_])?", re.ASCII)


def fetch(name: str) -> Path:
    """Download a weights file, or find it in the cache of the hub's client; return its path.

    Raises:
        InputError: if there are no such weights, the hub cannot be reached, or its client is not
            installed.
    """
    repository, _, revision = name.removeprefix(PREFIX).partition("@")
    check_name(repository, name)
    if not all(map(NAME_PART.fullmatch, revision.split("/"))) and revision:
        raise InputError(
            f"expected {PREFIX}OWNER/NAME@REVISION, found {shown(name)}; correct the revision"
        )
    hub = import_optional("huggingface_hub", "hub")

    with hub_errors(name, f"check the name and the network, and that {WEIGHTS_FILE} is there"):
        path = hub.hf_hub_download(
            repo_id=repository, filename=WEIGHTS_FILE, revision=revision or None
        )
        return Path(path)


def check_name(repository: str, name: str) -> None:
    """Check that a repository has the form OWNER/NAME; raise InputError with `name` if not."""
    if repository.count("/") != 1 or not all(map(NAME_PART.fullmatch, repository.split("/"))):
        raise InputError(
            f"expected {PREFIX}OWNER/NAME of letters, digits and -_. between them, found "
            f"{shown(name)}; correct the name"
        )


def hub_errors(name: str, advice: str) -> AbstractContextManager[None]:
    """Turn any error of the hub's client into one line, from the name to the advice."""

    # The classes of the errors depend on the versions of the client and its HTTP library.
    def message(error: BaseException) -> str:
        lines = [line.strip() for line in str(error).splitlines()]
        reason = next(filter(None, lines), "no more")
        kind = type(error).__name__
        return f"{name}: expected an answer of the hub, found {kind}: {reason}; {advice}"

    return one_line_errors(message)
