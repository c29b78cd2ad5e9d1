"""`python -m rtctl` is the command `rtctl`."""

import sys

from rtctl.cli import main

sys.exit(main())
