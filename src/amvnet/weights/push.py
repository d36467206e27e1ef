"""Upload weights and their model card to the Hugging Face hub."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from amvnet.errors import import_optional
from amvnet.weights.card import front_matter, model_card
from amvnet.weights.file import Weights, load, save
from amvnet.weights.hub import FILE, PREFIX, check_name, hub_errors

CARD = "README.md"


def push(
    weights: Weights | Path | str, name: str, licence: str | None = None, private: bool = False
) -> str:
    """Upload weights to the hub, with their card as README.md, from the account that is logged in.

    Args:
        weights: trained weights, or the name or path of a weights file.
        name: OWNER/NAME; the repository is created if it does not exist.
        licence: the hub's name of the licence, such as "apache-2.0" or "cc-by-nc-sa-4.0". Mind
            the terms of the data that the weights were trained on.
        private: make the repository private if it is created.

    Returns:
        The URL of the commit.

    Raises:
        InputError: if there are no such weights, the hub refuses them, or its client is not
            installed.
    """
    name = name.removeprefix(PREFIX)
    check_name(name, name)
    if not isinstance(weights, Weights):
        weights = load(weights)
    hub = import_optional("huggingface_hub", "hub")

    with TemporaryDirectory() as folder:
        save(weights, Path(folder) / FILE)
        card = front_matter(weights, licence) + model_card(weights, f"{PREFIX}{name}", licence)
        (Path(folder) / CARD).write_text(card, encoding="utf-8")

        with hub_errors(name, "check the name and the network, and log in with hf auth login"):
            hub.create_repo(repo_id=name, private=private, exist_ok=True)
            commit = hub.upload_folder(
                repo_id=name,
                folder_path=folder,
                allow_patterns=[FILE, CARD],
                commit_message="AMVNet weights",
            )

    return str(getattr(commit, "commit_url", commit))
