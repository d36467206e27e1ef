"""Run the command line: `python -m amvnet`, which is also what torchrun starts."""

import sys

from amvnet.cli.main import main

sys.exit(main())
