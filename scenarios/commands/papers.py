"""`quadsim reproduce`."""

from __future__ import annotations

import json
from argparse import Namespace

from scenarios.commands import EXIT_DONE, EXIT_FAILED, console
from scenarios.junit import junit_file, write_junit
from scenarios.many_flights import reproduce as reproduce_papers


def reproduce(options: Namespace) -> int:
    """`quadsim reproduce`."""
    if options.junit is not None:
        options.junit = junit_file(options.junit)
    found = reproduce_papers(options.paper, progress=not options.json)
    if options.junit is not None:
        write_junit(found, options.junit)
    within = all(each.within for each in found)
    if options.json:
        print(json.dumps({"reproduced": within, "papers": [each.to_json() for each in found]}, indent=2))
    else:
        console.print_grids([each.grid for each in found], None, prose=("number",))
    return EXIT_DONE if within else EXIT_FAILED
