"""What ships, each with a sentence; found without anything heavy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mpc.solvers import solver_entries
from quadsim.assets import read_toml, vehicle_names, vehicle_path
from quadsim.vehicle import load_vehicle
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


@dataclass(frozen=True, kw_only=True)
class LibraryScenario:
    """A scenario that ships.

    Attributes:
        name: for `load` and `fly`.
        description: one sentence.
        group: what it is an example of.
        expect: the verdict that it is meant to have: satisfied, violated or lost.

    Examples:
        >>> import quadsim
        >>> quadsim.scenarios()["helix"].group
        'courses'
    """

    name: str
    description: str
    group: Group
    expect: str


@dataclass(frozen=True, kw_only=True)
class Catalogue:
    """What ships, by name.

    Attributes:
        scenarios: for `load` and `fly`.
        campaigns: for `campaign`, with a sentence each, as all that follow.
        tunings: for `tune`.
        vehicles: for `load_vehicle` and `vehicle.file`.
        controllers: for `controller.type`.
        papers: for `reproduce`, by their titles.
        solvers: for `controller.solver`; those that are not installed are marked.

    Examples:
        >>> import quadsim
        >>> "hover" in quadsim.catalogue().to_json()["scenarios"]
        True
    """

    scenarios: Mapping[str, LibraryScenario]
    campaigns: Mapping[str, str]
    tunings: Mapping[str, str]
    vehicles: Mapping[str, str]
    controllers: Mapping[str, str]
    papers: Mapping[str, str]
    solvers: Mapping[str, str]

    def to_json(self) -> dict[str, Any]:
        """As plain values, those of scenarios by their field."""
        shipped = self.scenarios.values()
        return {
            "scenarios": {each.name: each.description for each in shipped},
            "groups": {each.name: each.group for each in shipped},
            "expected": {each.name: each.expect for each in shipped},
            "campaigns": dict(self.campaigns),
            "tunings": dict(self.tunings),
            "vehicles": dict(self.vehicles),
            "controllers": dict(self.controllers),
            "papers": dict(self.papers),
            "solvers": dict(self.solvers),
        }


def scenarios() -> dict[str, LibraryScenario]:
    """The scenarios that ship by name, sorted, each with its sentence and group.

    Examples:
        >>> import quadsim
        >>> "paper-constrained" in quadsim.scenarios()
        True
        >>> [name for name, each in quadsim.scenarios().items() if each.group == "ground"]
        ['ground-effect', 'hard-landing', 'take-off-and-landing']
    """
    found = {}
    for name in scenario_names():  # they are right, and not checked
        read = {"group": "other", "expect": "satisfied"} | read_toml(scenario_path(name))
        found[name] = LibraryScenario(
            name=name, description=read["description"], group=read["group"], expect=read["expect"]
        )
    return found


def catalogue() -> Catalogue:
    """Everything that ships: scenarios, campaigns, tunings, vehicles, controllers and QP solvers.

    Examples:
        >>> import quadsim
        >>> found = quadsim.catalogue()
        >>> "lopes2011" in found.vehicles
        True
        >>> found.controllers["lqr"]
        "infinite-horizon LQR on the hover model, following the reference's velocity"
    """
    return Catalogue(
        scenarios=scenarios(),
        campaigns={name: read_toml(campaign_path(name))["description"] for name in campaign_names()},
        tunings={name: read_toml(tuning_path(name))["description"] for name in tuning_names()},
        vehicles={name: load_vehicle(vehicle_path(name)).description for name in vehicle_names()},
        controllers=CONTROLLERS,
        papers={name: read_toml(paper_path(name))["title"] for name in paper_names()},
        solvers={name: entry.line for name, entry in solver_entries().items()},
    )
