"""Weights from and to the hub, and their card; the hub is a folder here, and no test needs a network."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

import amvnet
from amvnet.weights.card import model_card
from amvnet.weights.file import load, save

from fixtures.worlds import fails, fresh_weights, street, without
from fixtures.worlds import run_cli as verb

NAME = "hf-hub:somebody/streets"
POINTS = street(3, 300)[0]


class Hub:
    """What is used of the hub's client, on a folder: its repositories are folders of it."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.asked: list[dict[str, object]] = []

    def hf_hub_download(self, repo_id: str, filename: str, revision: str | None = None) -> str:
        self.asked.append({"repo_id": repo_id, "revision": revision})
        path = self.root / repo_id / filename
        if not path.is_file():
            raise FileNotFoundError(f"\n404 Client Error.\n\nEntry Not Found for {repo_id}.")
        return str(path)

    def create_repo(self, repo_id: str, private: bool, exist_ok: bool) -> None:
        self.asked.append({"repo_id": repo_id, "private": private})
        (self.root / repo_id).mkdir(parents=True, exist_ok=exist_ok)

    def upload_folder(
        self, repo_id: str, folder_path: str, allow_patterns: list[str], commit_message: str
    ) -> object:
        for name in allow_patterns:
            shutil.copy(Path(folder_path) / name, self.root / repo_id)
        return SimpleNamespace(commit_url=f"https://hub/{repo_id}/commit/1")


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Hub:
    found = Hub(tmp_path / "hub")
    monkeypatch.setitem(sys.modules, "huggingface_hub", found)  # type: ignore[arg-type]
    return found


def test_what_is_pushed_is_loaded(hub: Hub) -> None:
    assert (
        amvnet.push(fresh_weights(), NAME, private=True) == "https://hub/somebody/streets/commit/1"
    )
    assert sorted(path.name for path in (hub.root / "somebody/streets").iterdir()) == [
        "README.md",
        "model.safetensors",
    ]
    own, theirs = amvnet.Segmenter(fresh_weights()), amvnet.load(NAME)
    assert np.array_equal(own(POINTS).labels, theirs(POINTS).labels)
    assert hub.asked[0] == {"repo_id": "somebody/streets", "private": True}
    load(f"{NAME}@v2")
    assert hub.asked[-1] == {"repo_id": "somebody/streets", "revision": "v2"}


def test_the_verbs_take_names_of_the_hub(
    hub: Hub, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    amvnet.push(save(fresh_weights(), tmp_path / "w.safetensors"), "somebody/streets")
    POINTS.tofile(tmp_path / "a.bin")
    assert verb("predict", tmp_path / "a.bin", "--weights", NAME, "--out", tmp_path / "out") == (
        0,
        "",
    )
    assert verb("info", NAME) == (0, "")
    card = (hub.root / "somebody/streets/README.md").read_text()
    assert (
        capsys.readouterr().out.split("# hf-hub", 1)[1].strip()
        == card.split("# hf-hub", 1)[1].strip()
    )


def test_the_card_says_what_the_hub_and_people_need(hub: Hub) -> None:
    amvnet.push(fresh_weights(), NAME, licence="cc-by-nc-sa-4.0")
    _, front, card = (hub.root / "somebody/streets/README.md").read_text().split("---\n", 2)
    assert yaml.safe_load(front)["license"] == "cc-by-nc-sa-4.0"
    assert yaml.safe_load(front)["library_name"] == "amvnet"
    for words in (
        f'amvnet.load("{NAME}")',
        "traffic-sign",
        "sensor tiny",
        "| 50.0 |",
        "seed: 0",
        "cc-by-nc-sa-4.0",
    ):
        assert words in card
    assert "names no licence" in model_card(fresh_weights(), "w")


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
def test_the_cards_code_runs(dropped: tuple[str, ...], tmp_path: Path) -> None:
    path = save(without(fresh_weights(), *dropped), tmp_path / "w.safetensors")
    code = model_card(load(path), str(path)).split("```python\n")[1].split("```")[0]
    scores = np.full((len(POINTS), 19), 1 / 19, np.float32)
    names = {"points": POINTS, "f": scores, "g": scores}
    exec(code, names)
    found = names["labels"] if "labels" in names else names["result"].labels
    assert found.shape == (len(POINTS),)


def test_what_goes_wrong_is_one_line(
    hub: Hub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fails(lambda: load("hf-hub:nobody/nothing"), "nobody/nothing", "404", "model.safetensors")
    fails(lambda: load("hf-hub:nothing"), "OWNER/NAME")
    fails(lambda: amvnet.push(fresh_weights(), "streets"), "OWNER/NAME")
    (hub.root / "somebody/pickles").mkdir(parents=True)
    (hub.root / "somebody/pickles/model.safetensors").write_bytes(b"\x80\x04\x95")
    fails(lambda: load("hf-hub:somebody/pickles"), "safetensors")
    monkeypatch.setattr(
        hub, "upload_folder", lambda **more: (_ for _ in ()).throw(RuntimeError("no way in"))
    )
    fails(lambda: amvnet.push(fresh_weights(), NAME), "no way in", "hf auth login")


def test_without_the_extra_the_command_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    for call in (lambda: load(NAME), lambda: amvnet.push(fresh_weights(), NAME)):
        fails(call, "pip install 'amvnet[hub]'")
