"""`quadsim list`, `scenario` and `doctor`: what there is, its text, and what this machine can do with it."""

from __future__ import annotations

import json
from argparse import Namespace
from typing import Final, get_args

from quadsim.errors import InputError, ParameterError
from scenarios.catalogue import catalogue
from scenarios.commands import EXIT_DONE, console
from scenarios.shipped import Group, scenario_names

_MEANT: Final = {"violated": "  (meant to violate a constraint)", "lost": "  (meant to be lost)"}
"""The mark in `quadsim list` of a scenario that is to defeat its controller."""


def list_everything(options: Namespace) -> int:
    """`quadsim list`."""
    found = catalogue()
    if options.json:
        print(json.dumps(found.to_json(), indent=2))
        return EXIT_DONE
    by_group: dict[str, dict[str, str]] = {}
    for group in get_args(Group):
        members = [each for each in found.scenarios.values() if each.group == group]
        lines = {each.name: each.description + _MEANT.get(each.expect, "") for each in members}
        by_group |= {f"scenarios: {group}": lines} if lines else {}
    others = ("campaigns", "tunings", "vehicles", "controllers", "papers", "solvers")
    console.print_listing({**by_group, **{title: getattr(found, title) for title in others}})
    return EXIT_DONE


def scenario(options: Namespace) -> int:
    """`quadsim scenario`."""
    if options.schema:
        from scenarios.schema.json_schema import scenario_schema

        print(json.dumps(scenario_schema(), indent=2))
        return EXIT_DONE
    if options.vehicle is not None:
        from scenarios.vehicles import first_scenario

        given = {"a scenario": options.scenario, "--set": options.settings, "--seed": options.seed}
        for name, value in given.items():
            if value:
                raise ParameterError("", "--for", options.vehicle, f"given without {name}")
        choice = {"course": options.course, "controller": options.controller}
        chosen = {name: value for name, value in choice.items() if value is not None}
        print(first_scenario(options.vehicle, **chosen).to_toml(), end="")
        return EXIT_DONE
    for name, value in (("--course", options.course), ("--controller", options.controller)):
        if value is not None:
            raise ParameterError("", name, value, "given with --for alone")
    if options.scenario is None:
        raise InputError(
            f"scenario needs a name or a TOML file, or --schema (there are: {', '.join(scenario_names())})"
        )
    from scenarios.api import resolve
    from scenarios.commands.flights import load

    print(resolve(load(options.scenario, options)).to_toml(), end="")
    return EXIT_DONE


def doctor(options: Namespace) -> int:
    """`quadsim doctor`."""
    from scenarios.self_check import doctor as check_machine

    findings = check_machine()
    if options.json:
        print(json.dumps(findings, indent=2))
    else:
        console.print_listing(findings)
    return EXIT_DONE
