"""`python -m quadsim`: the `quadsim` command, also where its script is not on the PATH."""

from __future__ import annotations

import sys

from quadsim.commands.entry import main

if __name__ == "__main__":
    sys.exit(main())
