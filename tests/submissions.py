"""Data sets without labels, good predictions for them, and the rules of both official validators re-told plainly."""

from __future__ import annotations

import json
import shutil
import tracemalloc
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from worlds import GOLDEN, write_scan

from amvnet.data.taxonomy import SEMANTICKITTI

TEST = tuple(str(number) for number in range(11, 22))
Entries = dict[str, bytes]  # name -> content, folders with a last slash


# ---- the official rules, from their description, without the package


def official_semantickitti(path: Path, data: Path) -> list[str]:
    faults = []
    with zipfile.ZipFile(path) as archive:
        sizes = {entry.filename: entry.file_size for entry in archive.infolist()}
    wanted = ["sequences/"] + [
        f"sequences/{s}/{inner}" for s in TEST for inner in ("", "predictions/")
    ]
    faults += [f"folder {name}" for name in wanted if name not in sizes]
    for scan in sorted(data.glob("sequences/*/velodyne/*.bin")):
        if (sequence := scan.parts[-3]) in TEST:
            name = f"sequences/{sequence}/predictions/{scan.stem}.label"
            if sizes.get(name) != scan.stat().st_size // 16 * 4:
                faults.append(f"size {name}")
    return faults


def official_nuscenes(path: Path, data: Path) -> list[str]:
    faults = []
    tables = data / "v1.0-test"
    with zipfile.ZipFile(path) as archive:
        content = {
            entry.filename: archive.read(entry)
            for entry in archive.infolist()
            if not entry.is_dir()
        }
    meta = json.loads(content.get("test/submission.json", b'{"meta": {}}'))["meta"]
    keys = {"use_camera", "use_lidar", "use_radar", "use_map", "use_external"}
    if set(meta) != keys or not all(
        value in (True, False) and isinstance(value, bool) for value in meta.values()
    ):
        faults.append("meta")
    for row in json.loads((tables / "sample_data.json").read_text()):
        if row["is_key_frame"] and row["filename"].startswith("samples/LIDAR_TOP"):
            ids = content.get(f"lidarseg/test/{row['token']}_lidarseg.bin", b"")
            if len(ids) != (data / row["filename"]).stat().st_size // 20 or not all(
                0 < i <= 16 for i in ids
            ):
                faults.append(row["token"])
    return faults


# ---- worlds


@dataclass
class Case:
    """A data set without labels, predictions for it, and what a good archive of them has inside."""

    spec: str
    data: Path
    predictions: Path
    good: Entries
    official: Callable[[Path, Path], list[str]]

    def pack(
        self, path: Path, entries: Entries | None = None, method: int = zipfile.ZIP_DEFLATED
    ) -> Path:
        with zipfile.ZipFile(path, "w", method) as archive:
            for name, content in (self.good if entries is None else entries).items():
                archive.writestr(name, content)
        return path

    @property
    def first(self) -> str:
        return min(name for name in self.good if name.endswith((".label", ".bin")))


def make_semantickitti(root: Path, scans: int = 2) -> Case:
    rng, good = np.random.default_rng(0), dict.fromkeys(["sequences/"], b"")
    for sequence in TEST:
        good |= dict.fromkeys([f"sequences/{sequence}/", f"sequences/{sequence}/predictions/"], b"")
        for scan in range(scans):
            count = int(rng.integers(20, 40))
            write_scan(root / "data", sequence, f"{scan:06d}", rng.random((count, 4)), None)
            raw = rng.choice([*SEMANTICKITTI.train_to_raw, 252], count).astype(
                np.uint32
            ) | np.uint32(3 << 16)
            good[f"sequences/{sequence}/predictions/{scan:06d}.label"] = raw.astype("<u4").tobytes()
    write_files(root / "predictions", good)
    spec = f"semantickitti:{root / 'data'}"
    return Case(spec, root / "data", root / "predictions", good, official_semantickitti)


def make_nuscenes(root: Path) -> Case:
    """The golden set as if it were the test set: other names, no labels."""
    data = root / "data"
    shutil.copytree(GOLDEN / "nuscenes/samples", data / "samples")
    shutil.copytree(GOLDEN / "nuscenes/v1.0-mini", data / "v1.0-test")
    (data / "v1.0-test/lidarseg.json").unlink()
    results = GOLDEN / "nuscenes/results"
    good = {
        f"lidarseg/test/{p.name}": p.read_bytes() for p in sorted(results.glob("lidarseg/*/*.bin"))
    }
    good["test/submission.json"] = (results / "mini_val/submission.json").read_bytes()
    write_files(root / "predictions", good)
    return Case(f"nuscenes:{data}", data, root / "predictions", good, official_nuscenes)


def write_files(root: Path, entries: Entries) -> None:
    for name, content in entries.items():
        if not name.endswith("/"):
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            (root / name).write_bytes(content)


MAKERS: dict[str, Callable[[Path], Case]] = {
    "semantickitti": make_semantickitti,
    "nuscenes": make_nuscenes,
}


def measured(call: Callable[[], object]) -> tuple[object, int]:
    """What a call returns, and the most memory that it held at once, in bytes."""
    tracemalloc.start()
    try:
        return call(), tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
