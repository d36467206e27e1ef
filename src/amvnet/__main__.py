"""`python -m amvnet` is the command line, and what torchrun starts."""

import sys

from amvnet.cli.main import main

sys.exit(main())
