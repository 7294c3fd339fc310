"""quadsim: model predictive control of quadrotors in MuJoCo, recorded, filmed and audited constraint by constraint.

    import quadsim

    flight = quadsim.fly("paper-constrained")
    flight.outcome, flight.metrics["rmse.x"], flight.margins["roll"].min()

Public names are in `__all__` and imported on first use (PEP 562): `import quadsim` alone imports none of them.
"""

from __future__ import annotations

import importlib
import sys
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    __version__: str
    from quadsim.controller import Command as Command
    from quadsim.controller import Statistics as Statistics
    from quadsim.controller import StepInputs as StepInputs
    from quadsim.errors import QuadsimError as QuadsimError
    from quadsim.state import STATE_NAMES as STATE_NAMES
    from quadsim.state import State as State
    from quadsim.vehicle import Vehicle as Vehicle
    from scenarios.campaign.commands import campaign as campaign
    from scenarios.campaign.commands import replay as replay
    from scenarios.campaign.commands import sweep as sweep
    from scenarios.commands.app import catalogue as catalogue
    from scenarios.commands.app import check as check
    from scenarios.commands.app import compare as compare
    from scenarios.commands.app import doctor as doctor
    from scenarios.commands.app import feasibility as feasibility
    from scenarios.commands.app import film as film
    from scenarios.commands.app import fly as fly
    from scenarios.commands.app import load as load
    from scenarios.commands.app import load_vehicle as load_vehicle
    from scenarios.commands.app import make_controller as make_controller
    from scenarios.commands.app import plot as plot
    from scenarios.commands.app import problem as problem
    from scenarios.commands.app import read as read
    from scenarios.commands.app import run as run
    from scenarios.commands.app import start as start
    from scenarios.commands.app import view as view
    from scenarios.design.commands import scenario as scenario
    from scenarios.design.commands import vehicle_report as vehicle_report
    from scenarios.export.exporter import export as export
    from scenarios.export.in_the_loop import fly_exported as fly_exported
    from scenarios.flown import Flight as Flight
    from scenarios.identify.commands import identify as identify
    from scenarios.live.commands import live as live
    from scenarios.papers.commands import reproduce as reproduce
    from scenarios.rollout import Rollout as Rollout
    from scenarios.scenario_summary import scenario_html as scenario_html
    from scenarios.schema.json_schema import scenario_schema as scenario_schema
    from scenarios.schema.scenario import Scenario as Scenario

_FOLDER = Path(__file__).resolve().parents[1]
_OWN = ("mpc", "scenarios")


class _OwnPackages:
    """Finds `mpc` and `scenarios` beside this package, whatever else has these names on the path."""

    @staticmethod
    def find_spec(name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        """See `importlib.abc.MetaPathFinder`."""
        return PathFinder.find_spec(name, [str(_FOLDER)]) if name in _OWN else None


def _require_own_packages() -> None:
    """Find the packages by their place from now on.

    Raises:
        ImportError: another module of such a name has been imported already.
    """
    for name in _OWN:
        file = getattr(sys.modules.get(name), "__file__", None)
        if name in sys.modules and Path(file or "").resolve() != _FOLDER / name / "__init__.py":
            raise ImportError(
                f"quadsim has a package {name!r}, and {file or 'another one'} was imported under that name before: "
                "rename that file, or import quadsim first and do without it"
            )
    if not any(getattr(finder, "__name__", "") == _OwnPackages.__name__ for finder in sys.meta_path):
        sys.meta_path.insert(0, _OwnPackages)


_require_own_packages()


def _command() -> int:
    """The `quadsim` command: it starts here, so that it finds our own packages too; returns the exit status."""
    from scenarios.commands.entry import main

    return main()


_MODULES = {
    "quadsim.controller": "Command Statistics StepInputs",
    "quadsim.errors": "QuadsimError",
    "quadsim.state": "STATE_NAMES State",
    "quadsim.vehicle": "Vehicle",
    "scenarios.commands.app": "catalogue check compare doctor feasibility film fly load load_vehicle make_controller "
    "plot problem read run start view",
    "scenarios.campaign.commands": "campaign replay sweep",
    "scenarios.design.commands": "scenario vehicle_report",
    "scenarios.export.exporter": "export",
    "scenarios.export.in_the_loop": "fly_exported",
    "scenarios.flown": "Flight",
    "scenarios.identify.commands": "identify",
    "scenarios.live.commands": "live",
    "scenarios.papers.commands": "reproduce",
    "scenarios.rollout": "Rollout",
    "scenarios.scenario_summary": "scenario_html",
    "scenarios.schema.json_schema": "scenario_schema",
    "scenarios.schema.scenario": "Scenario",
}
_PUBLIC = {name: module for module, names in _MODULES.items() for name in names.split()}
__all__ = [*_PUBLIC]


def __getattr__(name: str) -> Any:
    """Import a public name on first use; `__version__` is that of the installed distribution."""
    if name == "__version__":
        from importlib.metadata import version  # late: it takes longer than all else here

        return globals().setdefault(name, version("quadsim"))
    if name not in _PUBLIC:
        raise AttributeError(f"module 'quadsim' has no attribute {name!r}")
    return globals().setdefault(name, getattr(importlib.import_module(_PUBLIC[name]), name))


def __dir__() -> list[str]:
    """The public names, imported or not, and the module's own."""
    return [*__all__, *(name for name in globals() if name.startswith("__"))]
