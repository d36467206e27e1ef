"""Run the command line: `amvnet`, or `python -m amvnet`, which is also what torchrun starts."""

import signal
import sys


def main() -> int:
    """Run the command line, as `amvnet.cli.main.main` does, and return the exit code.

    Until its modules are imported, Ctrl-C ends the process without a traceback.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from amvnet.cli.main import main as run

    return run()


if __name__ == "__main__":
    sys.exit(main())
