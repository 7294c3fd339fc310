"""`quadsim video` and `view`."""

from __future__ import annotations

from argparse import Namespace

from quadsim.errors import printable
from scenarios.api import film
from scenarios.api import view as view_run
from scenarios.commands import EXIT_DONE
from scenarios.commands.common import shown


def video(options: Namespace) -> int:
    """`quadsim video`."""
    path = film(options.run, options.out, overwrite=options.overwrite, workers=options.workers)
    print(f"written to {printable(shown(path))}")
    return EXIT_DONE


def view(options: Namespace) -> int:
    """`quadsim view`."""
    view_run(options.run, web=options.web)
    return EXIT_DONE
