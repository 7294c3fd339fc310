"""quadsim: model predictive control of quadrotors in MuJoCo, recorded, filmed and audited constraint by constraint.

    import quadsim

    flight = quadsim.fly("paper-constrained")
    flight.outcome, flight.metrics["rmse.x"], flight.margins["roll"].min()

What is public is named in `__all__` and imported when it is first used (PEP 562), so `import quadsim` costs nothing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from quadsim.controller import Command as Command
    from quadsim.controller import Moment as Moment
    from quadsim.errors import QuadsimError as QuadsimError
    from quadsim.vehicle import Vehicle as Vehicle
    from scenarios.api import check as check
    from scenarios.api import compare as compare
    from scenarios.api import feasibility as feasibility
    from scenarios.api import film as film
    from scenarios.api import fitting as fitting
    from scenarios.api import fly as fly
    from scenarios.api import load as load
    from scenarios.api import make_controller as make_controller
    from scenarios.api import read as read
    from scenarios.api import resolve as resolve
    from scenarios.api import start as start
    from scenarios.api import view as view
    from scenarios.catalogue import Catalogue as Catalogue
    from scenarios.catalogue import LibraryScenario as LibraryScenario
    from scenarios.catalogue import catalogue as catalogue
    from scenarios.catalogue import scenarios as scenarios
    from scenarios.export.exporter import export as export
    from scenarios.export.in_the_loop import fly_exported as fly_exported
    from scenarios.flight import Flight as Flight
    from scenarios.junit import write_junit as write_junit
    from scenarios.many_flights import campaign as campaign
    from scenarios.many_flights import replay as replay
    from scenarios.many_flights import reproduce as reproduce
    from scenarios.many_flights import sweep as sweep
    from scenarios.many_flights import tune as tune
    from scenarios.run import StartedFlight as StartedFlight
    from scenarios.schema.json_schema import scenario_schema as scenario_schema
    from scenarios.schema.scenario import Scenario as Scenario
    from scenarios.self_check import doctor as doctor
    from scenarios.vehicles import draw_vehicle as draw_vehicle
    from scenarios.vehicles import first_scenario as first_scenario
    from scenarios.vehicles import load_vehicle as load_vehicle
    from scenarios.vehicles import vehicle_report as vehicle_report
    from scenarios.vehicles import vehicle_template as vehicle_template

__version__ = "0.1.0"

_MODULES = {
    "scenarios.api": "check compare feasibility film fitting fly load make_controller read resolve start view",
    "scenarios.catalogue": "Catalogue LibraryScenario catalogue scenarios",
    "scenarios.export.exporter": "export",
    "scenarios.export.in_the_loop": "fly_exported",
    "scenarios.flight": "Flight",
    "scenarios.junit": "write_junit",
    "scenarios.many_flights": "campaign replay reproduce sweep tune",
    "scenarios.run": "StartedFlight",
    "scenarios.schema.json_schema": "scenario_schema",
    "scenarios.schema.scenario": "Scenario",
    "scenarios.self_check": "doctor",
    "scenarios.vehicles": "draw_vehicle first_scenario load_vehicle vehicle_report vehicle_template",
    "quadsim.controller": "Command Moment",
    "quadsim.errors": "QuadsimError",
    "quadsim.vehicle": "Vehicle",
}
_PUBLIC = {name: module for module, names in _MODULES.items() for name in names.split()}
__all__ = [*_PUBLIC]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used."""
    if name not in _PUBLIC:
        raise AttributeError(f"module 'quadsim' has no attribute {name!r}")
    return globals().setdefault(name, getattr(importlib.import_module(_PUBLIC[name]), name))


def __dir__() -> list[str]:
    """The public names, imported or not."""
    return sorted({*globals(), *_PUBLIC})
