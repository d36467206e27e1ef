"""Weights from and to the hub, and their card; the hub is a folder here, no network is needed."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

import amvnet
from amvnet.weights.card import model_card
from amvnet.weights.file import load, save

from fixtures.commands import fails, new_file, run_cli
from fixtures.tiny import fresh_weights, street, without

NAME = "hf-hub:somebody/streets"
POINTS = street(3, 300)[0]
WEIGHTS = fresh_weights()


class Hub:
    """The used part of the hub's client; every repository is a folder below `root`."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.calls: list[dict[str, object]] = []

    def hf_hub_download(self, repo_id: str, filename: str, revision: str | None = None) -> str:
        self.calls.append({"repo_id": repo_id, "revision": revision})
        path = self.root / repo_id / filename
        if not path.is_file():
            raise FileNotFoundError(f"\n404 Client Error.\n\nEntry Not Found for {repo_id}.")
        return str(path)

    def file_exists(self, repo_id: str, filename: str) -> bool:
        return (self.root / repo_id / filename).is_file()

    def create_repo(self, repo_id: str, private: bool, exist_ok: bool) -> None:
        self.calls.append({"repo_id": repo_id, "private": private})
        (self.root / repo_id).mkdir(parents=True, exist_ok=exist_ok)

    def upload_folder(
        self, repo_id: str, folder_path: str, allow_patterns: list[str], commit_message: str
    ) -> object:
        for name in allow_patterns:
            shutil.copy(Path(folder_path) / name, self.root / repo_id)
        return SimpleNamespace(commit_url=f"https://hub/{repo_id}/commit/1")


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Hub:
    hub = Hub(tmp_path / "hub")
    monkeypatch.setitem(sys.modules, "huggingface_hub", hub)
    return hub


def test_pushed_weights_can_be_loaded(hub: Hub) -> None:
    assert amvnet.push(WEIGHTS, NAME, private=True) == "https://hub/somebody/streets/commit/1"
    assert hub.calls[0] == {"repo_id": "somebody/streets", "private": True}
    folder = hub.root / "somebody/streets"
    assert sorted(path.name for path in folder.iterdir()) == ["README.md", "model.safetensors"]

    pushed = amvnet.load(WEIGHTS)
    assert np.array_equal(amvnet.load(NAME)(POINTS).labels, pushed(POINTS).labels)


@pytest.mark.parametrize("file", ["model.safetensors", "README.md"])
def test_what_the_hub_has_is_replaced_only_if_the_user_says_so(hub: Hub, file: str) -> None:
    mine = new_file(hub.root / "somebody/streets" / file, b"hours of work")
    fails(lambda: amvnet.push(WEIGHTS, NAME), "somebody/streets", file, "overwrite=True")
    assert list(mine.parent.iterdir()) == [mine]
    assert mine.read_bytes() == b"hours of work"

    amvnet.push(WEIGHTS, NAME, overwrite=True)
    assert mine.read_bytes() != b"hours of work"


HOSTILE = (
    *("a/..", "../a", "a/b/c", "/a", "a/", "a b/c", "a/b\n", "a/b\0", "a/-b", "ä/b"),
    "a/" + "b" * 200,
)


@pytest.mark.parametrize("name", HOSTILE)
def test_names_that_no_repository_can_have_never_reach_the_hub(hub: Hub, name: str) -> None:
    fails(lambda: amvnet.push(WEIGHTS, name), "OWNER/NAME")
    fails(lambda: load(f"hf-hub:{name}"), "OWNER/NAME")
    assert not hub.calls


@pytest.mark.parametrize("revision", ["..", "../../x", "refs/../x", "/x", "a b", "x/"])
def test_a_revision_is_no_path(hub: Hub, revision: str) -> None:
    fails(lambda: load(f"{NAME}@{revision}"), "@REVISION")
    assert not hub.calls


def test_a_revision_can_be_named(hub: Hub) -> None:
    amvnet.push(WEIGHTS, NAME)
    load(f"{NAME}@v2")
    assert hub.calls[-1] == {"repo_id": "somebody/streets", "revision": "v2"}


def test_the_commands_take_names_of_the_hub(
    hub: Hub, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    amvnet.push(save(WEIGHTS, tmp_path / "w.safetensors"), "somebody/streets")
    scan = tmp_path / "a.bin"
    POINTS.tofile(scan)
    assert run_cli("predict", scan, "--weights", NAME, "--out", tmp_path / "out") == (0, "")
    capsys.readouterr()

    # `info` prints the card that lies on the hub, without its front matter.
    assert run_cli("info", NAME) == (0, "")
    _, card = (hub.root / "somebody/streets/README.md").read_text().split("# hf-hub", 1)
    _, printed = capsys.readouterr().out.split("# hf-hub", 1)
    assert printed.strip() == card.strip()


def test_the_card_says_what_the_hub_and_people_need(hub: Hub) -> None:
    amvnet.push(WEIGHTS, NAME, licence="cc-by-nc-sa-4.0")
    _, front_matter, card = (hub.root / "somebody/streets/README.md").read_text().split("---\n", 2)

    metadata = yaml.safe_load(front_matter)
    assert (metadata["license"], metadata["library_name"]) == ("cc-by-nc-sa-4.0", "amvnet")

    assert f'amvnet.load("{NAME}")' in card
    assert "traffic-sign" in card
    assert "sensor tiny" in card
    assert "| 50.0 |" in card
    assert "| seed | 0 |" in card
    assert "cc-by-nc-sa-4.0" in card


def test_a_card_without_a_licence_says_so() -> None:
    assert "names no licence" in model_card(WEIGHTS, "w")


@pytest.mark.parametrize(
    "dropped",
    [
        (),
        ("point_head",),
        ("polar_net", "point_head"),
        ("range_net", "point_head"),
        ("range_net", "polar_net"),
    ],
)
def test_the_code_of_the_card_runs(dropped: tuple[str, ...], tmp_path: Path) -> None:
    path = save(without(WEIGHTS, *dropped), tmp_path / "w.safetensors")
    code = model_card(load(path), str(path)).split("```python\n")[1].split("```")[0]

    scores = np.full((len(POINTS), 19), 1 / 19, np.float32)
    names: dict[str, Any] = {"points": POINTS, "f": scores, "g": scores}
    exec(code, names)
    labels = names["labels"] if "labels" in names else names["result"].labels
    assert labels.shape == (len(POINTS),)


def test_a_name_that_cannot_be_loaded_is_one_line(hub: Hub) -> None:
    fails(lambda: load("hf-hub:nobody/nothing"), "nobody/nothing", "404", "model.safetensors")
    fails(lambda: load("hf-hub:nothing"), "OWNER/NAME")

    new_file(hub.root / "somebody/pickles/model.safetensors", b"\x80\x04\x95")
    fails(lambda: load("hf-hub:somebody/pickles"), "safetensors")


def test_a_push_that_fails_is_one_line(hub: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    fails(lambda: amvnet.push(WEIGHTS, "streets"), "OWNER/NAME")

    def refuse(**arguments: object) -> object:
        raise RuntimeError("no way in")

    monkeypatch.setattr(hub, "upload_folder", refuse)
    fails(lambda: amvnet.push(WEIGHTS, NAME), "no way in", "hf auth login")


def test_without_the_client_it_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    fails(lambda: load(NAME), 'pip install "amvnet[hub]"')
    fails(lambda: amvnet.push(WEIGHTS, NAME), 'pip install "amvnet[hub]"')
