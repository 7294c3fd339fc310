"""`quadsim list` and `scenario`: what there is, and what it says."""

from __future__ import annotations

import json
from argparse import Namespace
from typing import Any, Final, get_args

from mpc.solvers import SOLVERS
from quadsim.assets import read_toml, vehicle_names, vehicle_path
from quadsim.errors import InputError
from quadsim.vehicle import load_vehicle
from scenarios.commands import EXIT_DONE, console
from scenarios.shipped import CONTROLLERS, Group, campaign_names, campaign_path, scenario_names, scenario_path

_MEANT: Final = {"violated": "  (meant to violate a constraint)", "lost": "  (meant to be lost)"}
"""What `quadsim list` says of a scenario that is to defeat its controller."""


def list_everything(options: Namespace) -> int:
    """`quadsim list`; files that ship are right, and read without being checked."""
    scenarios: dict[str, dict[str, Any]] = {
        name: {"group": "other", "expect": "satisfied"} | read_toml(scenario_path(name)) for name in scenario_names()
    }
    sections = {
        "campaigns": {name: read_toml(campaign_path(name))["description"] for name in campaign_names()},
        "vehicles": {name: load_vehicle(vehicle_path(name)).description for name in vehicle_names()},
        "controllers": CONTROLLERS,
        "solvers": {name: entry.line for name, entry in SOLVERS.items()},
    }
    if options.json:
        keys = {"scenarios": "description", "groups": "group", "expected": "expect"}
        about = {title: {name: each[key] for name, each in scenarios.items()} for title, key in keys.items()}
        print(json.dumps({**about, **sections}, indent=2))
        return EXIT_DONE
    by_group: dict[str, dict[str, str]] = {}
    for group in get_args(Group):
        lines = {
            name: each["description"] + _MEANT.get(each["expect"], "")
            for name, each in scenarios.items()
            if each["group"] == group
        }
        by_group |= {f"scenarios: {group}": lines} if lines else {}
    console.print_listing({**by_group, **sections})
    return EXIT_DONE


def scenario(options: Namespace) -> int:
    """`quadsim scenario`."""
    from scenarios.build import resolve
    from scenarios.commands.common import load
    from scenarios.parts.vehicle import build_vehicle
    from scenarios.schema.course import CsvSpec

    if options.schema:
        from scenarios.schema.json_schema import scenario_schema

        print(json.dumps(scenario_schema(), indent=2))
        return EXIT_DONE
    if options.scenario is None:
        raise InputError(
            f"scenario needs a name or a TOML file, or --schema (there are: {', '.join(scenario_names())})"
        )
    loaded = load(options.scenario, options)
    resolved = resolve(loaded, build_vehicle(loaded))
    if isinstance(resolved.reference, CsvSpec):  # a start for one's own may have a table of its own
        resolved = resolved.model_copy(update={"reference": resolved.reference.model_copy(update={"sha256": None})})
    print(resolved.to_toml(), end="")
    return EXIT_DONE
