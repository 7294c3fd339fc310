"""quadsim: model predictive control of quadrotors in MuJoCo, recorded, filmed and audited constraint by constraint.

    import quadsim

    flight = quadsim.fly("paper-constrained")
    flight.outcome, flight.metrics["rmse.x"], flight.margins["roll"].min()

Public names are in `__all__` and imported on first use (PEP 562): `import quadsim` alone imports none of them.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from quadsim import shorthands

if TYPE_CHECKING:
    __version__: str
    from quadsim import mpc as mpc
    from quadsim.commands.app import catalogue as catalogue
    from quadsim.commands.app import check as check
    from quadsim.commands.app import compare as compare
    from quadsim.commands.app import doctor as doctor
    from quadsim.commands.app import feasibility as feasibility
    from quadsim.commands.app import film as film
    from quadsim.commands.app import fly as fly
    from quadsim.commands.app import load as load
    from quadsim.commands.app import load_vehicle as load_vehicle
    from quadsim.commands.app import make_controller as make_controller
    from quadsim.commands.app import plot as plot
    from quadsim.commands.app import problem as problem
    from quadsim.commands.app import read as read
    from quadsim.commands.app import run as run
    from quadsim.commands.app import start as start
    from quadsim.commands.app import view as view
    from quadsim.controller import Command as Command
    from quadsim.controller import Statistics as Statistics
    from quadsim.controller import StepInputs as StepInputs
    from quadsim.errors import QuadsimError as QuadsimError
    from quadsim.features.campaign.commands import campaign as campaign
    from quadsim.features.campaign.commands import replay as replay
    from quadsim.features.campaign.commands import sweep as sweep
    from quadsim.features.design.commands import scenario as scenario
    from quadsim.features.design.commands import vehicle_report as vehicle_report
    from quadsim.features.export.exporter import export as export
    from quadsim.features.export.in_the_loop import fly_exported as fly_exported
    from quadsim.features.identify.commands import identify as identify
    from quadsim.features.live.commands import live as live
    from quadsim.features.papers.commands import reproduce as reproduce
    from quadsim.features.stability.commands import stability as stability
    from quadsim.rollout.flown import Flight as Flight
    from quadsim.rollout.rollout import Rollout as Rollout
    from quadsim.scenarios.scenario_summary import scenario_html as scenario_html
    from quadsim.scenarios.schema.json_schema import scenario_schema as scenario_schema
    from quadsim.scenarios.schema.scenario import Scenario as Scenario
    from quadsim.state import STATE_NAMES as STATE_NAMES
    from quadsim.state import State as State
    from quadsim.vehicle import Vehicle as Vehicle


def _command() -> int:
    """The `quadsim` command; returns the exit status."""
    from quadsim.commands.entry import main

    return main()


_MODULES = {
    "quadsim.controller": "Command Statistics StepInputs",
    "quadsim.errors": "QuadsimError",
    "quadsim.state": "STATE_NAMES State",
    "quadsim.vehicle": "Vehicle",
    "quadsim.commands.app": "catalogue check compare doctor feasibility film fly load load_vehicle make_controller "
    "plot problem read run start view",
    "quadsim.features.campaign.commands": "campaign replay sweep",
    "quadsim.features.design.commands": "scenario vehicle_report",
    "quadsim.features.export.exporter": "export",
    "quadsim.features.export.in_the_loop": "fly_exported",
    "quadsim.rollout.flown": "Flight",
    "quadsim.features.identify.commands": "identify",
    "quadsim.features.live.commands": "live",
    "quadsim.features.papers.commands": "reproduce",
    "quadsim.features.stability.commands": "stability",
    "quadsim.rollout.rollout": "Rollout",
    "quadsim.scenarios.scenario_summary": "scenario_html",
    "quadsim.scenarios.schema.json_schema": "scenario_schema",
    "quadsim.scenarios.schema.scenario": "Scenario",
}
_PUBLIC: dict[str, str] = {}
for _module, _names in _MODULES.items():
    _PUBLIC |= dict.fromkeys(_names.split(), _module)
__all__ = [*_PUBLIC]


def __getattr__(name: str) -> Any:
    """Import a public name on first use; `mpc` is the package; `__version__` is that of the installed distribution."""
    if name == "__version__":
        from importlib.metadata import version  # late: it takes longer than all else here

        return globals().setdefault(name, version("quadsim"))
    if name == "mpc":
        return importlib.import_module("quadsim.mpc")
    if name not in _PUBLIC:
        raise AttributeError(f"module 'quadsim' has no attribute {name!r}")
    return globals().setdefault(name, getattr(importlib.import_module(_PUBLIC[name]), name))


shorthands.fly_scenario = lambda *arguments, **options: __getattr__("fly")(*arguments, **options)
shorthands.scenario_as_html = lambda scenario: __getattr__("scenario_html")(scenario)


def __dir__() -> list[str]:
    """The public names, imported or not, and the module's own."""
    own = [name for name in globals() if name.startswith("__")]
    return [*__all__, *own]
