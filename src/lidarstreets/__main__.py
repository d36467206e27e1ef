"""The command line: `python -m lidarstreets OUT`."""

import argparse
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

from lidarstreets import LIDAR_MODELS, SimulationError, simulate


def main(arguments: Sequence[str] | None = None) -> int:
    """Write labelled scans of simulated streets.

    Returns:
        The exit code: 0 if done, 2 if the input is wrong, 130 after Ctrl-C, 143 after SIGTERM.
    """
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    try:
        simulate(**vars(_parser().parse_args(arguments)))
    except SimulationError as error:
        print(f"lidarstreets: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("lidarstreets: interrupted; the same command continues", file=sys.stderr)
        return 130
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("python -m lidarstreets", description=simulate.__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("out", type=Path)
    parser.add_argument("--sensor", default="hdl64e", metavar="|".join(LIDAR_MODELS))
    parser.add_argument("--sequences", type=int, default=1)
    parser.add_argument("--scans", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first-sequence", type=int, default=0)
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    return parser


if __name__ == "__main__":
    sys.exit(main())
