"""What each command of `quadsim` does."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable
from typing import Final

from scenarios.commands.bench import bench
from scenarios.commands.campaigns import campaign, replay
from scenarios.commands.catalogue import doctor, list_everything, scenario, vehicle
from scenarios.commands.flights import check, compare, run
from scenarios.commands.products import video, view

COMMANDS: Final[dict[str, Callable[[Namespace], int]]] = {
    "list": list_everything,
    "run": run,
    "check": check,
    "compare": compare,
    "video": video,
    "view": view,
    "scenario": scenario,
    "vehicle": vehicle,
    "campaign": campaign,
    "replay": replay,
    "bench": bench,
    "doctor": doctor,
}
