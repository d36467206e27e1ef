"""What the command line says about wrong names and values, and in its help."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import pytest

from amvnet.cli.main import COMMANDS, main
from amvnet.cli.options import ScanChoice
from amvnet.cli.parser import HELP_ALL, add_recipe, field_texts, make_parser, run_with, with_options
from amvnet.config.schema import ModelConfig, Recipe

from fixtures.commands import refusal, refused, run_cli
from fixtures.marks import with_full

TRAIN = "train simulated-compact --data x --out o"
HUGE = "9" * 9000
PREDICT = "predict a.bin --weights x --out o"

# A command with a mistake, and what its line has to name.
WRONG_NAMES = {
    "predikt a.bin": "did you mean predict?",
    PREDICT + " --methd rv": "did you mean --method?",
    PREDICT.replace("--out", "--outt"): "found --outt; did you mean --out?",
    "view a.bin --sensor ouster": "name one of os0-32, os0-64, os0-128, os1-32, os1-64",
    "view a.bin --sensor OS1": "name one of os1-32, os1-64, os1-128, or give a YAML file",
    "view a.bin --sensor Velodyne": "name one of hdl64e, hdl32e, vlp16, vlp32c, vls128",
    "view a.bin --sensor vpl16": "did you mean vlp16?",
    PREDICT + " --method amvnt": "did you mean amvnet?",
    "export --weights sim-hdl64 --out o": "did you mean sim-hdl64e?",
    TRAIN.replace("compact", "compct"): "did you mean simulated-compact?",
    TRAIN + " --training.rv.epoch 3": "did you mean --training.rv.epochs?",
    TRAIN + " --trainig.rv.epochs 3": "did you mean --training.rv.epochs?",
    TRAIN + " --training.rv.region_loss dicee": "did you mean dice?",
}
WRONG_VALUES = {
    PREDICT + " --height many": "--height: expected a number, found 'many'",
    PREDICT + " --batch 1.5": "--batch: expected a whole number, found '1.5'",
    PREDICT + " --batch " + HUGE[:400]: "--batch: expected a number at least 1 and at most 1e+06",
    PREDICT + " --batch 0": "--batch: expected a number at least 1 and at most 1e+06, found '0'",
    PREDICT + " --at-once 0": "--at-once: expected a number at least 1 and at most 1e+06, found",
    PREDICT + " --tau 1.2": "--tau: expected a number at least 0 and at most 1, found '1.2'",
    PREDICT + " --sequences ,": "--sequences: expected values with commas, found ','",
    "evaluate x --methods rv,amvnt": "--methods: expected one of rv, ",
    "analyze x --weights w --out o --neighbours 5,0": "--neighbours: expected a number at least 1",
    "bench --runs 0": "--runs: expected a number at least 1 and at most 1e+06, found '0'",
    TRAIN + " --training.rv.lr many": "--training.rv.lr: expected a value like",
    TRAIN + " --training.rv.lr=-1": "--training.rv.lr: expected a number",
    TRAIN + " --model.range_net.widths [16,16]": "--model.range_net: expected as many widths",
    TRAIN + " --training.rv.lr {": "--training.rv.lr: expected a value",
    "train simulated-compact --data x": "expected --out, found none",
    "simulate o --seed " + HUGE: "--seed: expected a whole number, found '999",
    PREDICT + " --height " + HUGE: "--height: expected a number, found '999",
    PREDICT + " --height nan": "--height: expected a number, found 'nan'",
    TRAIN
    + " --training.seed "
    + "[" * 5000: "--training.seed: expected a value, found more than 50 levels",
}


WRONG = [*WRONG_NAMES.items(), *WRONG_VALUES.items()]
# A recipe has hundreds of options, which take time.
OF_A_RECIPE = [case for case in WRONG if case[0].startswith(TRAIN + " --training")]


@pytest.mark.parametrize(("command", "words"), with_full(WRONG, OF_A_RECIPE[3:]))
def test_one_line_names_the_option_and_what_was_meant(command: str, words: str) -> None:
    line = refusal(command)
    assert words in line
    assert len(line) < 1000
    assert line.count("--help") <= 1
    assert "?" not in line[:-2]  # nothing after a question
    assert "class" not in line.replace("class_weights", "")


@pytest.mark.parametrize("inputs", ["-first.bin", "a.bin -first.bin", "a.bin --first.bin"])
def test_a_file_whose_name_looks_like_an_option_is_told_how_to_be_given(
    inputs: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    name = inputs.split()[-1]
    Path(name).touch()
    line = refusal(f"predict {inputs} --weights sim-hdl64e --out o")
    assert line.endswith(f"found {name}; for the file of this name, give ./{name}\n")

    Path(name).unlink()
    refused(f"predict {inputs} --weights sim-hdl64e --out o", f"found {name}; ")


def test_values_that_begin_with_a_minus_need_no_equals_sign() -> None:
    words = "a --weights w --offset -1,0,0 --resume --height -.5 --out o"
    values = make_parser("predict", COMMANDS["predict"]).values(words.split())
    assert (values["offset"], values["height"]) == ("-1,0,0", -0.5)


@pytest.mark.parametrize("command", COMMANDS)
def test_help_is_in_words(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main([command, "--help"])
    assert caught.value.code == 0
    text = capsys.readouterr().out
    assert f"amvnet {command}" in text
    for word in ("class_path", "init_args", "<class", "Literal[", "null", "type:"):
        assert word not in text
    assert max(map(len, text.splitlines())) <= 120


def test_the_help_of_train_explains_every_recipe_value(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["train", "simulated-compact", "--help-all"])
    text = " ".join(capsys.readouterr().out.split())
    assert (
        "--training.rv.epochs EPOCHS Number of passes over the training scans. (default: 10)"
        in text
    )
    assert "--model.range_view: The range image" in text
    for key, words in field_texts(type(ModelConfig().polar_net)).items():
        assert f"--model.polar_net.{key} " in text
        assert words in text.replace("- ", "-")


@pytest.mark.parametrize("command", ["train", "ablate"])
def test_help_is_short_and_leaves_the_values_of_the_recipe_to_another_option(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for recipe in ([], ["nuscenes"]):
        with pytest.raises(SystemExit):
            main([command, *recipe, "--help"])
        lines = capsys.readouterr().out.splitlines()
        assert len(lines) < 100
        flags = [line.split()[0] for line in lines if line.startswith("  --")]
        assert {HELP_ALL, "--data", "--out"} <= set(flags)
        assert not any("." in flag for flag in flags)


def test_values_of_the_command_line_replace_those_of_the_recipe() -> None:
    parser = make_parser("train", COMMANDS["train"])
    add_recipe(parser, Recipe())
    words = ["simulated", "--data", "x", "--out", "o", "--training.rv.lr", "2e-3"]
    words += ["--model.range_net.gru", "false", "--model.point_head.hidden", "[8,4]"]
    recipe = with_options(Recipe(), parser.values(words))

    assert recipe.training.rv == dataclasses.replace(Recipe().training.rv, lr=0.002)
    assert recipe.model.range_net == dataclasses.replace(Recipe().model.range_net, gru=False)
    assert recipe.model.point_head.hidden == (8, 4)
    assert recipe.training.bev == Recipe().training.bev


def test_an_empty_recipe_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "empty.yaml"
    for text in ("", "# nothing yet\n", "{}\n"):
        path.write_text(text)
        refused(f"train {path} --data x --out o", "found an empty file")


def test_a_disks_error_without_a_reason_says_what_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise OSError("1000 requested and 0 written")

    monkeypatch.setattr(sys.modules["amvnet.cli.main"], "run", fail)
    code, line = run_cli("info")
    assert code == 1
    assert "None" not in line
    assert "1000 requested and 0 written" in line


def test_fields_of_a_dataclass_are_options_and_reach_the_command_in_it() -> None:
    calls: list[tuple[int, ScanChoice]] = []

    def command(count: int, choice: ScanChoice) -> None:
        """Do nothing.

        Args:
            count: a number.
            choice: which scans.
        """
        calls.append((count, choice))

    parser = make_parser("command", command)
    run_with(command, parser.values(["--count", "3", "--split", "val", "--topic", "/a"]))
    assert calls == [(3, ScanChoice(split="val", topic="/a"))]

    help_text = " ".join(parser.format_help().split())
    for field, text in field_texts(ScanChoice).items():
        assert f"--{field}" in help_text
        assert " ".join(text.split()) in help_text
