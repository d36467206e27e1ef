"""Check predictions by the rules of a benchmark's server, and pack them into an archive."""

from __future__ import annotations

import json
import stat
import zipfile
from pathlib import Path

from amvnet.data.labels.ids import check_size
from amvnet.errors import InputError
from amvnet.files import atomic_write
from amvnet.outputs import Signature
from amvnet.progress import Progress, no_progress
from amvnet.submission.rules import LIDAR_ALONE, Rules

ENDING = ".zip"
# The compression level of deflate. Level 9 takes five to eight times as long, and saves a sixth.
LEVEL = 6
# The time of every entry. It is fixed, so that the same content gives the same bytes.
LONG_AGO = (1980, 1, 1, 0, 0, 0)
# Archives begin with the entry of a folder.
ARCHIVE = Signature("an archive of submit", rb"PK\x03\x04.{26}(sequences|lidarseg)/PK")
UNIX = 3  # ZIP's code for entries that Unix wrote
FOLDER_BIT = 0x10  # the bit of an entry's MS-DOS attributes that marks a folder


def write(
    rules: Rules,
    folder: Path,
    out: Path,
    use_external: bool = False,
    progress: Progress = no_progress,
) -> int:
    """Check the predictions in a folder and pack them; return their number.

    The same predictions give the same bytes. Files that do not belong in the archive, such as
    scores or other splits, are left out. Only one scan at a time is in memory.

    Args:
        out: the archive, NAME.zip. It appears whole or not at all.
        use_external: whether the method also learnt from data outside the benchmark. Only archives
            for nuScenes state it.

    Raises:
        InputError: if a prediction is missing or breaks the rules, or the archive cannot be
            written.
    """
    if out.suffix != ENDING:
        raise InputError(
            f"{out}: expected a name that ends in {ENDING}, "
            f"found {out.suffix or 'no ending'}; rename it"
        )
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of predictions, found none; check the path")

    names = sorted(rules.points)
    missing = [name for name in names if not (folder / name).is_file()]
    if missing:
        others = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise InputError(
            f"{folder}: expected a prediction for each of {len(names)} scans, "
            f"found no {missing[0]}{others}; predict these scans too, "
            "or select predicted ones with --sequences or --split"
        )
    for name in names:
        size = (folder / name).stat().st_size
        check_size(folder / name, size, rules.points[name], rules.dtype)

    with atomic_write(out) as part, zipfile.ZipFile(part, "w") as archive:
        for name in rules.folders:
            _add(archive, name, b"")
        if rules.meta is not None:
            meta = {**LIDAR_ALONE, "use_external": use_external}
            _add(archive, rules.meta, json.dumps({"meta": meta}).encode())

        for done, name in enumerate(names):
            progress(done, len(names))
            data = (folder / name).read_bytes()
            rules.check_ids(data, folder / name)
            _add(archive, name, data)

    progress(len(names), len(names))
    return len(names)


def _add(archive: zipfile.ZipFile, name: str, data: bytes) -> None:
    """Add a file or a folder (NAME/) as an entry that is the same on all systems."""
    entry = zipfile.ZipInfo(name, LONG_AGO)
    entry.create_system = UNIX

    if name.endswith("/"):
        entry.external_attr = (stat.S_IFDIR | 0o755) << 16 | FOLDER_BIT
    else:
        entry.external_attr = (stat.S_IFREG | 0o644) << 16
        entry.compress_type = zipfile.ZIP_DEFLATED

    archive.writestr(entry, data, compresslevel=LEVEL)
