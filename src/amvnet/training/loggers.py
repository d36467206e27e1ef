"""Where the curves and pictures of a training go: Lightning's own loggers."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger
from matplotlib.figure import Figure

from amvnet.errors import InputError

LoggerName = Literal["tensorboard", "csv", "wandb", "mlflow"]
PROJECT = "amvnet"  # the project of Weights & Biases, and the experiment of MLflow
LIBRARIES = ("wandb", "mlflow")  # loggers that need a library of the same name
WITH_PICTURES = ("tensorboard", "wandb", "mlflow")


def check_logger(name: LoggerName) -> None:
    """Check that the library of a logger is installed.

    Raises:
        InputError: if it is not.
    """
    if name in LIBRARIES and find_spec(name) is None:
        raise InputError(
            f"expected {name} for --logger {name}, found none; pip install 'amvnet[{name}]'"
        )


def make_logger(name: LoggerName, folder: Path) -> Logger:
    """Return the logger of a stage.

    Args:
        name: which logger.
        folder: of the stage, in the folder of its run; what the logger writes goes there.

    Raises:
        InputError: if its library is missing.
    """
    check_logger(name)
    title = f"{folder.parent.name}/{folder.name}"
    makers: dict[str, Callable[[], Logger]] = {
        "tensorboard": lambda: TensorBoardLogger(folder, name="", version=""),
        # In a folder of its own, as metrics.csv in the stage's folder has a row per epoch.
        "csv": lambda: CSVLogger(folder, name="csv", version=""),
        "wandb": lambda: _wandb(title, folder),
        "mlflow": lambda: _mlflow(title, folder),
    }
    return makers[name]()


def _wandb(title: str, folder: Path) -> Logger:
    from lightning.pytorch.loggers import WandbLogger

    return WandbLogger(name=title, project=PROJECT, save_dir=folder)


def _mlflow(title: str, folder: Path) -> Logger:
    from lightning.pytorch.loggers import MLFlowLogger

    # The variable MLFLOW_TRACKING_URI of the user counts more than the folder.
    return MLFlowLogger(PROJECT, run_name=title, save_dir=str(folder / "mlruns"))


def log_figure(logger: Logger | None, name: str, figure: Figure, epoch: int) -> None:
    """Give a picture to a logger; those without pictures leave it out."""
    writer: Any = getattr(logger, "experiment", None)
    kind = type(logger).__name__
    if kind == "TensorBoardLogger":
        writer.add_figure(name, figure, epoch)
    elif kind == "WandbLogger":
        logger.log_image(name, [figure])  # type: ignore[union-attr]
    elif kind == "MLFlowLogger":
        run: Any = logger
        writer.log_figure(run.run_id, figure, f"{name}/{epoch:04d}.png")
