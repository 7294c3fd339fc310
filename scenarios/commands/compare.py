"""`quadsim compare`: of runs and of campaigns."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

from scenarios.api import compare as compare_all
from scenarios.commands import EXIT_DONE, console
from scenarios.comparison import Comparison


def compare(options: Namespace) -> int:
    """`quadsim compare`."""
    found = compare_all(*options.targets, out=options.out, overwrite=options.overwrite)
    if isinstance(found, Comparison):
        for note in found.notes:
            console.say(note)
        if options.markdown:
            print(found.to_markdown())
        else:
            console.print_comparison(found.rows, found.names, str(found.page))
        return EXIT_DONE
    from scenarios.campaign.report.comparison_tables import comparison_markdown
    from scenarios.commands.campaign_console import print_comparison

    if options.markdown:
        print(comparison_markdown(found))
    else:
        print_comparison(found, str(Path(options.out) / "index.html"))
    return EXIT_DONE
