"""The progress of a campaign: a bar on a terminal, lines elsewhere.

`commands` passes the function that `watching` yields to `campaign.fly_campaign`, which calls it after every flight.
"""

from __future__ import annotations

import contextlib
import datetime
from collections.abc import Iterator

from quadsim.console.progress import lines
from quadsim.features.campaign.campaign import CampaignProgress, Watch
from quadsim.features.campaign.statistics import interval, proportion


@contextlib.contextmanager
def watching(progress: bool) -> Iterator[Watch]:
    """Yield the function that shows a campaign's progress: a bar on a terminal, elsewhere a line at intervals."""
    from quadsim.console.console import stderr

    screen = stderr()
    if not progress:
        yield lambda state: None
    elif screen.is_terminal:
        from rich.progress import BarColumn, TextColumn
        from rich.progress import Progress as Bars

        with Bars(
            TextColumn("flights"), BarColumn(), TextColumn("{task.description}"), console=screen, transient=True
        ) as bars:
            bar = bars.add_task("starting the campaign")

            def move_bar(state: CampaignProgress) -> None:
                bars.update(bar, completed=state.flown, total=state.flights, description=_describe(state))

            yield move_bar
    else:
        with lines(screen, "starting the campaign") as print_line:

            def print_progress(state: CampaignProgress) -> None:
                if state.flown < state.flights:
                    print_line(f"flights {_describe(state)}")
                else:
                    print_line("report")

            yield print_progress


def _describe(state: CampaignProgress) -> str:
    """Return flights done, rate, time left and failures in one line."""
    share = proportion(state.failed, state.flown)
    seconds_left = (state.flights - state.flown) / state.rate
    left = datetime.timedelta(seconds=round(seconds_left))
    return (
        f"{state.flown}/{state.flights}, {state.rate:.2f}/s, {left} left; "
        f"{state.failed} failed ({interval(share['lower'], share['upper'])})"
    )
