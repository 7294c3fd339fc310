"""The shipped scenarios, campaigns, papers and controllers by name; found without heavy imports."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal, get_args

from quadsim.assets import read_toml, vehicle_names, vehicle_path
from quadsim.errors import FileError, UnknownNameError
from scenarios.results import Result, Shown

_LIBRARY: Final = Path(__file__).resolve().parent / "library"
FLIGHTS, CAMPAIGNS, PAPERS = (_LIBRARY / name for name in ("flights", "campaigns", "papers"))

Group = Literal["paper", "papers", "courses", "air", "faults", "ground", "space", "sensors", "other"]

CONTROLLERS: Final = {
    "unconstrained": "the paper's Sec. 4: a constant gain from the unconstrained optimum",
    "constrained": "the paper's Sec. 5: a QP's optimum in every period, tilt, rotor speeds and their steps bounded",
    "robust": "constrained, with soft bounds, rotor lag, delay, disturbances, heading and more, each switched on alone",
    "nonlinear": "nonlinear MPC at any attitude: a quaternion model, sequential quadratic programming",
    "lqr": "infinite-horizon LQR on the hover model, following the reference's velocity",
    "pid": "cascaded PID, as autopilots fly it",
    "geometric": "geometric tracking control on SE(3)",
}
"""Repeated here, so that `quadsim list` need not import them."""
_MEANT: Final = {"violated": "  (meant to violate a constraint)", "lost": "  (meant to be lost)"}
"""Marks scenarios that are meant to defeat their controller."""


def _names(folder: Path) -> list[str]:
    """Return the names of the files in a folder, sorted."""
    return sorted(path.stem for path in folder.glob("*.toml"))


def _path(kind: str, folder: Path, name: str) -> Path:
    """Return the file of a shipped name, or the path itself if it ends in `.toml`; raise if it does not exist."""
    if name.endswith(".toml"):
        if not Path(name).is_file():
            raise FileError(name, f"no such {kind} file")
        return Path(name)
    if name not in _names(folder):
        raise UnknownNameError(kind, name, _names(folder), hint="or give a path ending in .toml")
    return folder / f"{name}.toml"


scenario_names, scenario_path = partial(_names, FLIGHTS), partial(_path, "scenario", FLIGHTS)
campaign_names, campaign_path = partial(_names, CAMPAIGNS), partial(_path, "campaign", CAMPAIGNS)
paper_names, paper_path = partial(_names, PAPERS), partial(_path, "paper", PAPERS)


@dataclass(frozen=True, kw_only=True)
class LibraryScenario:
    """A shipped scenario."""

    description: str  # one sentence
    group: Group  # its group of examples
    expect: str  # expected verdict: satisfied, violated or lost


@dataclass(frozen=True, kw_only=True)
class Catalogue(Result):
    """Everything shipped, by name."""

    scenarios: Mapping[str, LibraryScenario]  # for `load` and `fly`
    campaigns: Mapping[str, str]  # for `campaign`; the values here and below are one-line descriptions
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
                    n: entry.description + _MEANT.get(entry.expect, "") for n, entry in shipped if entry.group == group
                }
            )
        }
        others = ("campaigns", "vehicles", "controllers", "papers", "solvers")
        return console.listing({**groups, **{title: getattr(self, title) for title in others}})

    def to_json(self) -> dict[str, Any]:
        """Return plain values; those of scenarios by field."""
        shipped = self.scenarios.items()
        columns = {"scenarios": "description", "groups": "group", "expected": "expect"}
        by_field = {title: {name: getattr(entry, field) for name, entry in shipped} for title, field in columns.items()}
        return {**by_field, **{title: value for title, value in asdict(self).items() if title != "scenarios"}}


def read_catalogue() -> Catalogue:
    """Read everything shipped, without checking the files."""
    from mpc.solvers import solver_entries
    from quadsim.vehicle import load_vehicle

    scenarios = {}
    for name in scenario_names():
        read = {"group": "other", "expect": "satisfied"} | read_toml(scenario_path(name))
        scenarios[name] = LibraryScenario(description=read["description"], group=read["group"], expect=read["expect"])
    return Catalogue(
        scenarios=scenarios,
        campaigns={name: read_toml(campaign_path(name))["description"] for name in campaign_names()},
        vehicles={name: load_vehicle(vehicle_path(name)).description for name in vehicle_names()},
        controllers=CONTROLLERS,
        papers={name: read_toml(paper_path(name))["title"] for name in paper_names()},
        solvers={name: entry.line for name, entry in solver_entries().items()},
    )
