"""What ships, each with a sentence; found without anything heavy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final, get_args

from mpc.solvers import solver_entries
from quadsim.assets import read_toml, vehicle_names, vehicle_path
from quadsim.vehicle import load_vehicle
from scenarios.results import Result, Shown
from scenarios.shipped import (
    CONTROLLERS,
    Group,
    campaign_names,
    campaign_path,
    paper_names,
    paper_path,
    scenario_names,
    scenario_path,
    tuning_names,
    tuning_path,
)

_MEANT: Final = {"violated": "  (meant to violate a constraint)", "lost": "  (meant to be lost)"}
"""The mark of a scenario that is to defeat its controller."""


@dataclass(frozen=True, kw_only=True)
class LibraryScenario:
    """A scenario that ships."""

    description: str  # one sentence
    group: Group  # what it is an example of
    expect: str  # the verdict that it is meant to have: satisfied, violated or lost


@dataclass(frozen=True, kw_only=True)
class Catalogue(Result):
    """What ships, by name."""

    scenarios: Mapping[str, LibraryScenario]  # for `load` and `fly`
    campaigns: Mapping[str, str]  # for `campaign`, with a sentence each, as all that follow
    tunings: Mapping[str, str]  # for `tune`
    vehicles: Mapping[str, str]  # for `load_vehicle` and `vehicle.file`
    controllers: Mapping[str, str]  # for `controller.type`
    papers: Mapping[str, str]  # for `reproduce`, by their titles
    solvers: Mapping[str, str]  # for `controller.solver`; those that are not installed are marked

    def shown(self) -> Shown:
        """See `Result.shown`."""
        from scenarios import console

        shipped = self.scenarios.items()
        groups = {
            f"scenarios: {group}": lines
            for group in get_args(Group)
            if (
                lines := {
                    n: each.description + _MEANT.get(each.expect, "") for n, each in shipped if each.group == group
                }
            )
        }
        others = ("campaigns", "tunings", "vehicles", "controllers", "papers", "solvers")
        return console.listing({**groups, **{title: getattr(self, title) for title in others}})

    def to_json(self) -> dict[str, Any]:
        """As plain values, those of scenarios by their field."""
        shipped = self.scenarios.items()
        columns = {"scenarios": "description", "groups": "group", "expected": "expect"}
        by_field = {title: {name: getattr(each, field) for name, each in shipped} for title, field in columns.items()}
        return {**by_field, **{title: value for title, value in asdict(self).items() if title != "scenarios"}}


def read_catalogue() -> Catalogue:
    """Everything that ships; files are right, and not checked."""
    scenarios = {}
    for name in scenario_names():
        read = {"group": "other", "expect": "satisfied"} | read_toml(scenario_path(name))
        scenarios[name] = LibraryScenario(description=read["description"], group=read["group"], expect=read["expect"])
    return Catalogue(
        scenarios=scenarios,
        campaigns={name: read_toml(campaign_path(name))["description"] for name in campaign_names()},
        tunings={name: read_toml(tuning_path(name))["description"] for name in tuning_names()},
        vehicles={name: load_vehicle(vehicle_path(name)).description for name in vehicle_names()},
        controllers=CONTROLLERS,
        papers={name: read_toml(paper_path(name))["title"] for name in paper_names()},
        solvers={name: entry.line for name, entry in solver_entries().items()},
    )
