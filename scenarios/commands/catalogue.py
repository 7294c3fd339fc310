"""`quadsim list`, `scenario`, `vehicle` and `doctor`: what there is, and what it says."""

from __future__ import annotations

import json
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Final, get_args

from mpc.solvers import SOLVERS
from quadsim.assets import vehicle_names, vehicle_path
from quadsim.errors import InputError, ParameterError
from quadsim.vehicle import load_vehicle, vehicle_sources
from scenarios.build import CONTROLLERS, resolve
from scenarios.campaign.plan import campaign_names, read_campaign
from scenarios.commands import EXIT_DONE, console
from scenarios.commands.common import load
from scenarios.loading import load_scenario, scenario_names
from scenarios.parts.vehicle import build_vehicle
from scenarios.schema.course import CsvSpec
from scenarios.schema.scenario import Group, Scenario

_MEANT: Final = {"violated": "  (meant to violate a constraint)", "lost": "  (meant to be lost)"}
"""What `quadsim list` says of a scenario that is to defeat its controller."""


def list_everything(options: Namespace) -> int:
    """`quadsim list`."""
    scenarios = [load_scenario(name) for name in scenario_names()]
    sections = {
        "campaigns": {name: read_campaign(name)["description"] for name in campaign_names()},
        "vehicles": {name: load_vehicle(vehicle_path(name)).description for name in vehicle_names()},
        "controllers": dict(CONTROLLERS),
        "solvers": {name: entry.line for name, entry in SOLVERS.items()},
    }
    if options.json:
        about = {
            "scenarios": {each.name: each.description for each in scenarios},
            "groups": {each.name: each.group for each in scenarios},
            "expected": {each.name: each.expect for each in scenarios},
        }
        print(json.dumps({**about, **sections}, indent=2))
    else:
        console.print_listing({**_by_group(scenarios), **sections})
    return EXIT_DONE


def scenario(options: Namespace) -> int:
    """`quadsim scenario`."""
    if options.schema:
        from scenarios.schema.json_schema import scenario_schema

        print(json.dumps(scenario_schema(), indent=2))
        return EXIT_DONE
    if options.vehicle is not None:
        from scenarios.design.first_scenario import COURSES, LAWS, first_scenario

        given = {"a scenario": options.scenario, "--set": options.settings, "--seed": options.seed}
        for name, value in given.items():
            if value:
                raise ParameterError("", "--for", options.vehicle, f"given without {name}")
        made = first_scenario(
            load_vehicle(vehicle_path(options.vehicle)),
            options.vehicle,
            course=options.course or COURSES[0],
            law=options.controller or LAWS[0],
        )
        print(made.to_toml(), end="")
        return EXIT_DONE
    for name, value in (("--course", options.course), ("--controller", options.controller)):
        if value is not None:
            raise ParameterError("", name, value, "given with --for alone")
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


def vehicle(options: Namespace) -> int:
    """`quadsim vehicle`."""
    if options.template:
        from scenarios.design.vehicle_template import vehicle_template

        print(vehicle_template(), end="")
        return EXIT_DONE
    from scenarios.commands.vehicle_sheet import make_sheet, sheet_tables, sheet_to_json, shortfall_table
    from scenarios.design.shortfalls import shortfalls

    if options.vehicle is None:
        raise InputError(
            f"vehicle needs a name or a TOML file, or --template (there are: {', '.join(vehicle_names())})"
        )
    path = vehicle_path(options.vehicle)
    loaded, sources = load_vehicle(path), vehicle_sources(path)
    if options.out is not None:
        from quadsim.report.film.video import render_portrait

        if Path(options.out).suffix != ".png":
            raise ParameterError("", "--out", options.out, "a file ending in .png")
        render_portrait(loaded, Path(options.out))
    sheet = make_sheet(loaded)
    missed = None if options.scenario is None else shortfalls(load_scenario(options.scenario), loaded)
    if options.json:
        about = {} if missed is None else {"scenario": options.scenario, "shortfalls": missed}
        print(json.dumps(sheet_to_json(loaded, sheet, sources) | about, indent=2))
    else:
        tables = sheet_tables(loaded, sheet, sources)
        tables += [] if missed is None else [shortfall_table(options.scenario, missed)]
        console.print_grids(tables, options.out, prose=("unit", "source", "what and why"))
    return EXIT_DONE


def doctor(options: Namespace) -> int:
    """`quadsim doctor`."""
    from scenarios.commands.doctor import examine

    findings = examine()
    if options.json:
        print(json.dumps(findings, indent=2))
    else:
        console.print_listing(findings)
    return EXIT_DONE


def _by_group(scenarios: Sequence[Scenario]) -> dict[str, dict[str, str]]:
    """One line per scenario, by group; those that are to defeat their controller say so."""
    found: dict[str, dict[str, str]] = {}
    for group in get_args(Group):
        lines = {each.name: each.description + _MEANT.get(each.expect, "") for each in scenarios if each.group == group}
        found |= {f"scenarios: {group}": lines} if lines else {}
    return found
