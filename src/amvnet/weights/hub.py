"""Weights from the Hugging Face hub, by name. Safetensors only."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from amvnet.errors import InputError

PREFIX = "hf-hub:"
FILE = "model.safetensors"


def fetch(name: str) -> Path:
    """The file of `hf-hub:OWNER/NAME`, or of `hf-hub:OWNER/NAME@REVISION`; the hub's client keeps it on disk.

    Raises:
        InputError: where there are no such weights, the hub cannot be reached, or its client is not installed.
    """
    place, _, revision = name.removeprefix(PREFIX).partition("@")
    check_name(place, name)
    hub = client()
    with hub_errors(name, f"check the name and the network, and that {FILE} is there"):
        return Path(hub.hf_hub_download(repo_id=place, filename=FILE, revision=revision or None))


def check_name(place: str, name: str) -> None:
    """Raises InputError where a place on the hub is not OWNER/NAME."""
    if place.count("/") != 1 or not all(place.split("/")):
        raise InputError(f"expected {PREFIX}OWNER/NAME, found {name!r}; name both")


def client() -> Any:
    """The hub's own client; raises InputError where it is not installed."""
    try:
        import huggingface_hub
    except ImportError:
        raise InputError(
            "expected huggingface_hub for the hub, found none; pip install 'amvnet[hub]'"
        ) from None
    return huggingface_hub


@contextmanager
def hub_errors(name: str, cure: str) -> Iterator[None]:
    """What the hub's client complains of as one line, with what to do."""
    try:
        yield
    except (
        Exception
    ) as error:  # which kinds there are depends on its version, and that of its HTTP library
        said = next((line.strip() for line in str(error).splitlines() if line.strip()), "no more")
        raise InputError(
            f"{name}: expected an answer of the hub, found {type(error).__name__}: {said}; {cure}"
        ) from None
