"""Check that two states of this project compute the same results, to the bit.

    python benchmarks/same_results.py make OUT [--real FOLDER]
    python benchmarks/same_results.py compare BEFORE AFTER

`make` runs amvnet, the installed one or the one in PYTHONPATH, through its command line and its
public functions. It keeps their outputs in OUT, and writes a digest of each array, tensor, figure
and graph into OUT/digests.json. Dates, durations, versions and progress text are left out. `--real`
adds real scans. Its FOLDER has semantickitti/ and nuscenes/ in the layout of their benchmarks, and
formats/ with scan files of other formats.

`compare` prints the differences between two such folders, and their size if the files still exist.
It exits with 1 if there are any. Both folders must come from one machine, the same libraries and
one version of this script: PYTHONPATH chooses the commit that is measured.

`make` takes about a quarter of an hour on one core, and two minutes more for the real scans.
"""

from __future__ import annotations

import argparse
import base64
import csv
import hashlib
import itertools
import json
import os
import re
import resource
import shlex
import subprocess
import sys
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, get_args

import numpy as np
import yaml
from safetensors import safe_open

import amvnet
from amvnet.cli.main import COMMANDS, WITH_RECIPE
from amvnet.cli.options import FormatName  # type: ignore[attr-defined]  # as in earlier commits
from amvnet.config.recipes import recipe_names
from amvnet.models.methods import MethodName
from amvnet.weights.file import built_in

DIGESTS = "digests.json"
LOG = "log.txt"  # the file with the lines that the commands print
REAL = "real"  # a link to the real scans, so that no output names their place
CACHE = "cache"  # the folder of exported networks
LAS_DATE = slice(90, 94)  # bytes of the header that hold the day and the year

# Files that are not compared. Checkpoints and TensorBoard's curves hold times, and the weights of
# each stage hold everything else that matters.
LEFT_OUT = {REAL, CACHE, LOG, DIGESTS}
LEFT_OUT_ANYWHERE = ("*.ckpt", "*.tfevents.*")

# Entries of JSON and YAML files that differ between equal runs or between installations.
VOLATILE = {"seconds", "made_by", "versions", "python"}

# Use one thread, because sums over several threads depend on how they share the work.
SETTINGS = {
    "OMP_NUM_THREADS": "1",
    "OMP_WAIT_POLICY": "passive",
    "COLUMNS": "10000",  # so that the help of each option is one line
    "PYTHONSAFEPATH": "1",  # so that no folder of OUT is taken for a package
}

# Networks of a few thousand parameters, every kind of augmentation, a head that learns from views.
# They are based on the recipes of the paper, because the compact recipes change.
TINY = """
base: {base}
model:
  range_view: {{width: 256}}
  polar_view: {{radial: 32, angular: 32, vertical: 8}}
  range_net: {{stem: 8, widths: {widths}, blocks: {blocks}, decoder: 16, head: 16, dropout: 0.1}}
  polar_net: {{point_widths: [8, 16], pillar: 8, widths: [16, 16], decoder: [16]}}
  assertion: {{threshold: 0.95}}
  point_head: {{neighbours: 4, hidden: [8, 8], fc: 8}}
training:
  rv: {{epochs: 2, batch: 2, lr: 0.02}}
  bev: {{epochs: 2, batch: 2, lr: 0.02, accumulate: 2}}
  head: {{epochs: 2, batch: 64, lr: 0.05, points: 4000, drawn: 0, views: 1}}
  augment: {{height: 0.1, intensity: 0.2, no_intensity: 0.3, drop: 0.1, mix: 0.5}}
  precision: {precision}
  workers: 0
  accelerator: cpu
"""
RECIPES = {
    "kitti.yaml": TINY.format(
        base="semantickitti",
        widths=[8, 8, 16, 16, 16, 16, 16],
        blocks=[1, 1, 1, 1, 1, 1, 1],
        precision="32-true",
    ),
    "nuscenes.yaml": TINY.format(
        base="nuscenes",
        widths=[8, 8, 16, 16, 16, 16],
        blocks=[1, 1, 1, 1, 1, 1],
        precision="bf16-mixed",
    ),
}

# Each line is a command of amvnet, run in OUT. A line with {weights}, {method} or {format} is run
# with each value that the package has; {methods} are all methods.
COMMAND_LINES = """
simulate city64 --sequences 3 --scans 1 --seed 5 --processes 1
simulate city32 --sequences 3 --scans 2 --seed 6 --processes 1 --sensor hdl32e
simulate street --sequences 1 --scans 6 --seed 9 --processes 1 --spacing 1
check city64
list

# Labels of the built-in weights, by every method
predict city64 --weights sim-hdl64e --method {method} --scores --out labels/methods/{method}
predict city64 --weights sim-hdl64e --scores --uncertain --out labels/64
predict city32 --weights sim-hdl32e --scores --uncertain --out labels/32
predict city32 --weights sim-hdl32e --method ensemble --batch 2 --out labels/batch
predict city32 --sequences simulated-0000 --weights sim-hdl32e --precision bfloat16 --scores \
    --out labels/bfloat16

# Lone scans: each format of labels; a sensor that is measured, named and described
predict city64/sequences/00/velodyne --weights {weights} --format {format} --uncertain \
    --out lone/{weights}/{format}
predict city64/sequences/00/velodyne --weights sim-hdl64e --format npy --uncertain \
    --sensor os1-64 --height 1.2 --out lone/sensor
predict city64/sequences/00/velodyne --weights sim-hdl64e --format npy --axes y-forward \
    --rotate 0,5,0 --offset 0.5,0,0.1 --intensity-scale 2 --out lone/frame
fleet city64/sequences/00/velodyne --weights sim-hdl64e --workers 1 --out labels/fleet

# Drives
predict street --weights sim-hdl64e --drive --out labels/drive
map street --weights sim-hdl64e --out map.las --json figures/map.json

# Figures and pictures
evaluate city64 --split all --weights sim-hdl64e --json figures/64.json --methods {methods}
evaluate city32 --sequences simulated-0000 --weights sim-hdl32e --json figures/32.json \
    --pictures figures/32 --methods {methods}
evaluate city64 --split all --predictions labels/64 --json figures/files.json
analyze city64 --split all --weights sim-hdl64e --out figures/analysis

# Two models' scores
fuse city64 --scores-a labels/methods/rv --scores-b labels/methods/bev --out fused/ensemble
fuse city64 --scores-a labels/64 --scores-b labels/64 --head sim-hdl64e --tau 0.7 --out fused/head
rank city32 --weights sim-hdl32e --out rank/suspects.csv

# What others read
view city64 --weights sim-hdl64e --scans 2 --html pages/weights.html
view city32 --labels labels/32 --scans 2 --html pages/labels.html
submit city64 --sequences 00 --predictions labels/64 --out archives/64.zip
submit city32 --sequences simulated-0000 --predictions labels/32 --use-external \
    --out archives/32.zip

# Training
train kitti.yaml --data city64 --out runs/kitti --train-sequences 00,01 --val-sequences 02
train nuscenes.yaml --data city32 --out runs/nuscenes --training.workers 1
train kitti.yaml --data city64 --out runs/tau --stage head --init runs/kitti \
    --train-sequences 00,01 --val-sequences 02 --model.assertion.threshold 0.8
train kitti.yaml --data city64 --out runs/scores --stage head --with-val \
    --scores-a labels/64 --scores-b labels/64
train finetune --data city64 --out runs/finetune --init runs/kitti --train-sequences 00 \
    --val-sequences 02 --training.rv.epochs 1 --training.bev.epochs 1 --training.workers 0
adapt street --weights runs/kitti --out runs/adapted --epochs 1 --streets 0
ablate nuscenes.yaml --data city32 --out runs/ablation --training.rv.epochs 1
analyze city64 --sequences 02 --weights runs/kitti --out runs/analysis --neighbours 2 \
    --recipe kitti.yaml --train-sequences 00,01
predict city64 --sequences 02 --weights runs/kitti --scores --uncertain --out labels/trained
predict city64 --sequences 02 --weights runs/kitti --engine onnx --out labels/onnx

# Graphs
export --weights {weights} --out graphs/{weights}
export --weights sim-hdl64e --out graphs/int8 --int8 city64
"""
REAL_COMMAND_LINES = f"""
predict {REAL}/semantickitti --weights sim-hdl64e --out real-labels/kitti
predict {REAL}/nuscenes --weights sim-hdl32e --scores --uncertain --out real-labels/nuscenes
predict {REAL}/formats --weights {{weights}} --scores --uncertain --out real-labels/{{weights}}
evaluate {REAL}/semantickitti --split all --predictions real-labels/kitti --json figures/kitti.json
"""
METHODS = get_args(MethodName)
VALUES = {"weights": tuple(built_in()), "method": METHODS, "format": get_args(FormatName)}

Part = np.ndarray | str


def main() -> int:
    """Run a command; return the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    subparsers = parser.add_subparsers(dest="command", required=True)
    making = subparsers.add_parser("make", help="run everything and digest the results")
    making.add_argument("out", type=Path, metavar="OUT", help="a new folder")
    making.add_argument("--real", type=Path, metavar="FOLDER", help="real scans")
    comparing = subparsers.add_parser("compare", help="print what differs")
    comparing.add_argument("before", type=Path, metavar="BEFORE")
    comparing.add_argument("after", type=Path, metavar="AFTER")
    subparsers.add_parser("library", help="what `make` runs within OUT to use the public functions")
    arguments = parser.parse_args()

    if arguments.command == "make":
        make(arguments.out, arguments.real)
        return 0
    if arguments.command == "compare":
        return compare(arguments.before, arguments.after)
    use_library()
    return 0


# ---- running


def make(out: Path, real: Path | None) -> None:
    """Run all commands in a new folder, and digest what they write."""
    if out.exists():
        sys.exit(f"{out}: expected no such folder, found one; give another")

    out.mkdir(parents=True)
    if real is not None:
        (out / REAL).symlink_to(real.resolve())
    for name, text in RECIPES.items():
        (out / name).write_text(text)

    run = Runner(out)
    print(f"measuring {amvnet.__file__}")
    save_help(run, out / "help")
    for words in words_of_lines(COMMAND_LINES + (REAL_COMMAND_LINES if real else "")):
        run("-m", "amvnet", *words)
    run(str(Path(__file__).resolve()), "library")

    digests = {"exit codes": run.codes}
    for path in files_to_digest(out):
        parts = read_parts(out / path)
        digests[path] = {name: digest(part) for name, part in parts.items()}
    (out / DIGESTS).write_text(json.dumps(digests, indent=1))
    print(f"{len(digests)} files in {out / DIGESTS}")


def save_help(run: Runner, folder: Path) -> None:
    """Write what `--help` prints, a file for each command and for each recipe."""
    folder.mkdir()
    commands = [(name,) for name in COMMANDS]
    for words in (*commands, *itertools.product(WITH_RECIPE[:1], recipe_names())):
        (folder / f"{'-'.join(words)}.help").write_text(run("-m", "amvnet", *words, "--help"))


def words_of_lines(text: str) -> Iterator[list[str]]:
    """Yield the words of each line with each value; lines that end in a backslash go on."""
    for line in text.replace("\\\n", " ").splitlines():
        names = [name for name in VALUES if f"{{{name}}}" in line]
        for values in itertools.product(*(VALUES[name] for name in names)):
            named = dict(zip(names, values, strict=True))
            if words := shlex.split(line.format(**named, methods=",".join(METHODS)), comments=True):
                yield words


class Runner:
    """Runs Python programs in a folder, one after the other.

    Attributes:
        codes: exit code of each program, by its words.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.codes: dict[str, str] = {}
        self.environment = os.environ | SETTINGS | {"AMVNET_CACHE": str(folder.resolve() / CACHE)}
        if "PYTHONPATH" in os.environ:  # its folders may be relative to this one
            paths = os.environ["PYTHONPATH"].split(os.pathsep)
            self.environment["PYTHONPATH"] = os.pathsep.join(map(os.path.abspath, paths))

    def __call__(self, *words: str) -> str:
        """Run a program, and return its output. Print its CPU time, and the reason if it fails."""
        shown = shlex.join([Path(words[0]).name, *words[1:]]).removeprefix("-m ")
        started = cpu_seconds()
        done = subprocess.run(
            (sys.executable, *words),
            check=False,
            cwd=self.folder,
            env=self.environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        print(f"{cpu_seconds() - started:6.1f} s  {shown}", flush=True)

        self.codes[shown] = str(done.returncode)
        with (self.folder / LOG).open("a") as log:
            log.write(f"$ {shown}\n{done.stdout}\n")
        if done.returncode:
            tail = "\n".join(done.stdout.splitlines()[-5:])
            print(f"exit code {done.returncode}:\n{tail}", flush=True)
        return done.stdout


def cpu_seconds() -> float:
    """Return the CPU time of the programs so far. Other programs do not affect it."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def use_library() -> None:
    """Save the results of the public functions in the folder `library`."""
    folder = Path("library")
    folder.mkdir()
    amvnet.simulate(folder / "city", sensor="hdl32e", sequences=2, scans=1, seed=7, processes=2)

    points = np.fromfile("city64/sequences/00/velodyne/000000.bin", np.float32).reshape(-1, 4)
    points[::1000] = np.nan  # lost returns
    for method in METHODS:
        result = amvnet.load("sim-hdl64e", method=method)(points)
        save_segmentation(folder / f"{method}.npz", result)

    result = amvnet.load("sim-hdl64e")(points)
    assert result.rv is not None
    assert result.bev is not None
    labels = amvnet.fuse(points, result.rv, result.bev, head="sim-hdl64e", tau=0.7)
    np.savez(folder / "fused.npz", labels=labels)


def save_segmentation(path: Path, result: Any) -> None:
    """Save the arrays of a Segmentation."""
    arrays: dict[str, Any] = {}
    for name in ("labels", "uncertain", "scores", "rv", "bev"):
        array = getattr(result, name)
        if array is not None:  # a single network has no scores of the other
            arrays[name] = array
    np.savez(path, **arrays)


# ---- reading what was written


def files_to_digest(out: Path) -> list[str]:
    """Return the compared files below a folder, relative to it."""
    files: list[str] = []
    for path in sorted(out.rglob("*")):
        name = path.relative_to(out)
        left_out = name.parts[0] in LEFT_OUT or any(map(name.match, LEFT_OUT_ANYWHERE))
        if path.is_file() and not left_out:
            files.append(str(name))
    return files


def digest(part: Part) -> str:
    """Return the SHA-256 of a part of a file. The digest of an array covers its type and shape."""
    if isinstance(part, str):
        return hashlib.sha256(part.encode()).hexdigest()
    head = f"{part.dtype.str} {part.shape} ".encode()
    return hashlib.sha256(head + part.tobytes()).hexdigest()


def read_parts(path: Path) -> dict[str, Part]:
    """Read the compared parts of a file: its arrays, its figures, or all of its bytes."""
    read = READERS.get(path.suffix, read_bytes)
    return read(path)


def read_bytes(path: Path) -> dict[str, Part]:
    return {"bytes": hashlib.sha256(path.read_bytes()).hexdigest()}


def read_las(path: Path) -> dict[str, Part]:
    """Read the bytes of a LAS file without its date of creation."""
    content = bytearray(path.read_bytes())
    content[LAS_DATE] = bytes(LAS_DATE.stop - LAS_DATE.start)
    return {"bytes": hashlib.sha256(content).hexdigest()}


def read_labels(path: Path) -> dict[str, Part]:
    """Read the raw ids of SemanticKITTI."""
    return {"labels": np.fromfile(path, np.uint32)}


def read_points_or_labels(path: Path) -> dict[str, Part]:
    """Read points, or the labels of nuScenes, which have the same ending."""
    if path.stem.endswith("_lidarseg"):
        return {"labels": np.fromfile(path, np.uint8)}
    return {"points": np.fromfile(path, np.float32)}


def read_array(path: Path) -> dict[str, Part]:
    return {"array": np.load(path)}


def read_arrays(path: Path) -> dict[str, Part]:
    with np.load(path) as arrays:
        return dict(arrays)


def read_weights(path: Path) -> dict[str, Part]:
    """Read the tensors of a weights file, and its description."""
    with safe_open(path, "numpy") as file:
        parts = flatten(json.loads(file.metadata()["amvnet"]), "description.")
        for name in file.keys():  # noqa: SIM118  not a dictionary
            parts[name] = file.get_tensor(name)
    return parts


def read_json(path: Path) -> dict[str, Part]:
    return flatten(json.loads(path.read_text()))


def read_yaml(path: Path) -> dict[str, Part]:
    return flatten(yaml.safe_load(path.read_text()))


def flatten(tree: Any, prefix: str = "") -> dict[str, Part]:
    """Return the leaves of nested dictionaries as JSON, by their paths. Lists count as leaves."""
    if not isinstance(tree, dict):
        return {prefix.removesuffix("."): json.dumps(tree)}

    leaves: dict[str, Part] = {}
    for key, value in tree.items():
        if key not in VOLATILE:
            leaves |= flatten(value, f"{prefix}{key}.")
    return leaves


def read_journal(path: Path) -> dict[str, Part]:
    """Read the rows of a journal without the scans' times and places, their second and eighth."""
    head, *rows = map(json.loads, path.read_text().splitlines())
    return flatten(head) | {name: json.dumps(values[:5]) for name, _, *values in rows}


def read_table(path: Path) -> dict[str, Part]:
    """Read the columns of a CSV file, without speeds."""
    with path.open(newline="") as file:
        head, *rows = csv.reader(file)

    parts: dict[str, Part] = {}
    for name, *values in zip(head, *rows, strict=True):
        if not name.endswith("/s"):
            parts[name] = " ".join(values)
    return parts


def read_help(path: Path) -> dict[str, Part]:
    """Read the options of a command with their types and defaults, without their descriptions."""
    text = re.sub(r"\bamvnet[\w.]*\.", "", path.read_text())  # a class may move to another module
    parts: dict[str, Part] = {}
    for option in re.split(r"\n  (?=-)", text)[1:]:
        name, *_ = option.split()
        type_and_default = re.search(r"\((?:required|type:|default:).*\)", option)
        parts[name] = type_and_default[0] if type_and_default else ""
    return parts


def read_page(path: Path) -> dict[str, Part]:
    """Read the scans and their description within a page of `view`."""
    parts: dict[str, Part] = {}
    elements = re.findall(
        r'<script type="(\S+)" id="(\S+)">(.*?)</script>', path.read_text(), re.DOTALL
    )
    for kind, name, text in elements:
        if kind == "application/json":
            parts |= flatten(json.loads(text), f"{name}.")
        else:
            parts[name] = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8)
    return parts


def read_archive(path: Path) -> dict[str, Part]:
    parts = read_bytes(path)
    with zipfile.ZipFile(path) as archive:
        for name in archive.namelist():
            parts[name] = hashlib.sha256(archive.read(name)).hexdigest()
    return parts


def read_graph(path: Path) -> dict[str, Part]:
    """Read the bytes of an ONNX file, and its operators and tensors, which explain differences."""
    import onnx

    graph = onnx.load(path).graph
    parts = read_bytes(path) | {"operators": " ".join(node.op_type for node in graph.node)}
    for tensor in graph.initializer:
        parts[tensor.name] = onnx.numpy_helper.to_array(tensor)
    return parts


READERS: dict[str, Callable[[Path], dict[str, Part]]] = {
    ".las": read_las,
    ".label": read_labels,
    ".bin": read_points_or_labels,
    ".npy": read_array,
    ".npz": read_arrays,
    ".safetensors": read_weights,
    ".json": read_json,
    ".jsonl": read_journal,
    ".yaml": read_yaml,
    ".csv": read_table,
    ".help": read_help,
    ".html": read_page,
    ".zip": read_archive,
    ".onnx": read_graph,
}


# ---- comparing


def compare(before: Path, after: Path) -> int:
    """Print the differences between the results in two folders; return 1 if there are any."""
    old = json.loads((before / DIGESTS).read_text())
    new = json.loads((after / DIGESTS).read_text())
    paths = sorted(old.keys() | new.keys())
    differing = 0

    for path in paths:
        found: list[tuple[str, str]] = []
        if path not in old or path not in new:
            found = [("", f"is only in the {'first' if path in old else 'second'}")]
        elif old[path] != new[path]:
            found = list(differences(old[path], new[path], before / path, after / path))

        differing += bool(found)
        for name, difference in found:
            print(f"{path}: {name} {difference}")

    print(f"{differing} of {len(paths)} files differ")
    return 1 if differing else 0


def differences(
    old: dict[str, str], new: dict[str, str], before: Path, after: Path
) -> Iterator[tuple[str, str]]:
    """Yield the name and the difference of each part of a file whose digests differ."""
    old_parts: dict[str, Part] = {}
    new_parts: dict[str, Part] = {}
    if before.is_file() and after.is_file():
        old_parts = read_parts(before)
        new_parts = read_parts(after)

    for name in sorted(old.keys() | new.keys()):
        if name not in new:
            yield name, "is only in the first"
        elif name not in old:
            yield name, "is only in the second"
        elif old[name] != new[name]:
            # Without the files, their digests are shown. Exit codes are their own digests.
            old_part = old_parts.get(name, old[name])
            new_part = new_parts.get(name, new[name])
            yield name, f"differs{how(old_part, new_part)}"


def how(old: Part, new: Part) -> str:
    """Describe by how much two parts differ."""
    if isinstance(old, str) or isinstance(new, str):
        return f": {old[:60]} -> {new[:60]}"
    if (old.shape, old.dtype) != (new.shape, new.dtype):
        return f": {old.dtype} {old.shape} -> {new.dtype} {new.shape}"

    unequal = old != new
    text = f" in {np.count_nonzero(unequal):,} of {old.size:,} values"
    if old.dtype.kind == "f":
        largest = np.nanmax(np.abs(old.astype(np.float64) - new), initial=0)
        text += f", by {largest:.3g} at most"
    return text


if __name__ == "__main__":
    sys.exit(main())
