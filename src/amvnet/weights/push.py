"""Weights shared on the Hugging Face hub, with their card."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from amvnet.weights.card import front_matter, model_card
from amvnet.weights.file import Weights, load, save
from amvnet.weights.hub import FILE, PREFIX, check_name, client, hub_errors

CARD = "README.md"


def push(
    weights: Weights | Path | str, name: str, licence: str | None = None, private: bool = False
) -> str:
    """Share weights as OWNER/NAME on the hub, as who is logged in there; with their card as README.md.

    Args:
        weights: trained weights, or the name or path of a weights file.
        name: OWNER/NAME; made where it is not there.
        licence: the hub's name of one, such as "apache-2.0" or "cc-by-nc-sa-4.0": of data, mind their terms.
        private: show it to nobody else.

    Returns:
        The address of the commit.

    Raises:
        InputError: where there are no such weights, the hub refuses them, or its client is not installed.
    """
    name = name.removeprefix(PREFIX)
    check_name(name, name)
    given = weights if isinstance(weights, Weights) else load(weights)
    hub = client()
    with TemporaryDirectory() as folder:
        save(given, Path(folder) / FILE)
        card = front_matter(given, licence) + model_card(given, f"{PREFIX}{name}", licence)
        (Path(folder) / CARD).write_text(card, encoding="utf-8")
        with hub_errors(name, "check the name and the network, and log in by hf auth login"):
            hub.create_repo(repo_id=name, private=private, exist_ok=True)
            made = hub.upload_folder(
                repo_id=name,
                folder_path=folder,
                allow_patterns=[FILE, CARD],
                commit_message="AMVNet weights",
            )
    return str(getattr(made, "commit_url", made))
