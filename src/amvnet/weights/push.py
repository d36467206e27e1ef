"""Upload weights and their model card to the Hugging Face hub."""

from __future__ import annotations

from pathlib import Path

from amvnet.errors import InputError, import_optional
from amvnet.files import temporary_folder
from amvnet.weights.card import front_matter, model_card
from amvnet.weights.file import Weights, load, save
from amvnet.weights.hub import PREFIX, WEIGHTS_FILE, check_name, hub_errors

CARD_FILE = "README.md"


def push(
    weights: Weights | Path | str,
    name: str,
    licence: str | None = None,
    private: bool = False,
    *,
    overwrite: bool = False,
) -> str:
    """Upload weights and their card (README.md) to the hub, from the account that is logged in.

    Args:
        weights: trained weights, or the name or path of a weights file.
        name: OWNER/NAME; the repository is created if it does not exist.
        licence: the hub's name of the licence, such as "apache-2.0" or "cc-by-nc-sa-4.0". Mind
            the terms of the data that the weights were trained on.
        private: make the repository private if it is created.
        overwrite: replace the weights and the card of the repository; the hub keeps the earlier
            files in its history.

    Returns:
        The URL of the commit.

    Raises:
        InputError: if there are no such weights, the repository has weights or a card and
            `overwrite` is false, the hub refuses the upload, or its client is not installed.
    """
    name = name.removeprefix(PREFIX)
    check_name(name, name)
    if not isinstance(weights, Weights):
        weights = load(weights)
    hub = import_optional("huggingface_hub", "hub")

    advice = "check the name and the network, and log in with hf auth login"
    with hub_errors(name, advice):
        present = [file for file in (WEIGHTS_FILE, CARD_FILE) if hub.file_exists(name, file)]
    if present and not overwrite:
        raise InputError(
            f"{name}: expected a repository without {present[0]}, found one; push to another name, "
            "or say overwrite=True to replace it"
        )

    with temporary_folder() as folder:
        save(weights, folder / WEIGHTS_FILE)
        card = front_matter(weights, licence) + model_card(weights, f"{PREFIX}{name}", licence)
        (folder / CARD_FILE).write_text(card, encoding="utf-8")

        with hub_errors(name, advice):
            hub.create_repo(repo_id=name, private=private, exist_ok=True)
            commit = hub.upload_folder(
                repo_id=name,
                folder_path=folder,
                allow_patterns=[WEIGHTS_FILE, CARD_FILE],
                commit_message="AMVNet weights",
            )

    return str(getattr(commit, "commit_url", commit))
