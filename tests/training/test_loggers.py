"""The curves of a training go to the logger that the user names."""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args

import pytest
from lightning.pytorch.loggers import MLFlowLogger, WandbLogger
from matplotlib.figure import Figure

from amvnet.evaluation.top_view import TopView
from amvnet.training import callbacks, plan
from amvnet.training.callbacks import log_figure, make_logger
from amvnet.training.plan import LIBRARIES, LoggerName, check_logger

from fixtures.worlds import fails, make_streets, refusal, succeed, write_recipe


@pytest.mark.parametrize("name", ["tensorboard", "csv"])
def test_a_logger_writes_into_the_folder_of_its_stage(name: LoggerName, tmp_path: Path) -> None:
    logger = make_logger(name, tmp_path / "rv")
    logger.log_metrics({"loss": 1.5}, 0)
    log_figure(logger, "00/000000", Figure(), 0)
    logger.save()
    files = [path for path in (tmp_path / "rv").rglob("*") if path.is_file()]
    assert files
    if name == "csv":
        assert [path.relative_to(tmp_path) for path in files] == [Path("rv/csv/metrics.csv")]
        assert "1.5" in files[0].read_text()


@pytest.mark.parametrize("name", LIBRARIES)
def test_a_missing_library_is_named_before_anything_is_trained(
    name: LoggerName, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(plan, "find_spec", lambda library: None)
    fails(lambda: check_logger(name), f"pip install 'amvnet[{name}]'")

    data = make_streets(tmp_path / "data")
    recipe = tmp_path / "recipe.yaml"
    write_recipe(recipe)
    line = refusal(f"train {recipe} --data {data} --out {tmp_path / 'run'} --logger {name}")
    assert name in line
    assert not (tmp_path / "run").exists()


def test_nothing_is_drawn_for_a_logger_without_pictures(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    drawn: list[TopView] = []

    def draw(view: TopView) -> Figure:
        drawn.append(view)
        return Figure()

    monkeypatch.setattr(callbacks, "scan_figure", draw)
    data = make_streets(tmp_path / "data")
    recipe = write_recipe(tmp_path / "recipe.yaml")

    options = f"--data {data} --stage rv --training.rv.epochs 1"
    succeed(f"train {recipe} {options} --out {tmp_path / 'csv'} --logger csv")
    assert not drawn
    succeed(f"train {recipe} {options} --out {tmp_path / 'tensorboard'}")
    assert len(drawn) == 2


def test_pictures_go_to_loggers_that_take_them() -> None:
    calls: list[Any] = []

    class FakeWandb(WandbLogger):
        def __init__(self) -> None:
            pass

        def log_image(self, *arguments: Any) -> None:  # type: ignore[override]
            calls.append(arguments)

    class FakeMLFlow(MLFlowLogger):
        run_id = "7"

        def __init__(self) -> None:
            pass

        @property
        def experiment(self) -> Any:
            return self

        def log_figure(self, *arguments: Any) -> None:
            calls.append(arguments)

    figure = Figure()
    fakes: list[Any] = [FakeWandb(), FakeMLFlow(), None]
    for logger in fakes:
        log_figure(logger, "a", figure, 3)
    assert calls == [("a", [figure]), ("7", figure, "a/0003.png")]


def test_the_command_line_takes_every_logger() -> None:
    from amvnet.cli.main import VERBS
    from amvnet.cli.parser import literals, make_parser

    parser = make_parser("train", VERBS["train"])
    assert literals(parser.kinds["--logger"]) == get_args(LoggerName)
