"""`quadsim doctor`."""

from __future__ import annotations

import json
from argparse import Namespace

from scenarios.commands import EXIT_DONE, console
from scenarios.self_check import doctor as check_machine


def doctor(options: Namespace) -> int:
    """`quadsim doctor`."""
    findings = check_machine()
    if options.json:
        print(json.dumps(findings, indent=2))
    else:
        console.print_listing(findings)
    return EXIT_DONE
