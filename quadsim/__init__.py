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
    from scenarios.api import campaign as campaign
    from scenarios.api import check as check
    from scenarios.api import compare as compare
    from scenarios.api import film as film
    from scenarios.api import fly as fly
    from scenarios.api import load as load
    from scenarios.api import load_vehicle as load_vehicle
    from scenarios.api import make_controller as make_controller
    from scenarios.api import read as read
    from scenarios.api import replay as replay
    from scenarios.api import reproduce as reproduce
    from scenarios.api import scenarios as scenarios
    from scenarios.api import sweep as sweep
    from scenarios.flight import Flight as Flight
    from scenarios.schema.scenario import Scenario as Scenario

__version__ = "0.1.0"

_PLACES = {
    "scenarios.api": (
        "campaign",
        "check",
        "compare",
        "film",
        "fly",
        "load",
        "load_vehicle",
        "make_controller",
        "read",
        "replay",
        "reproduce",
        "scenarios",
        "sweep",
    ),
    "scenarios.flight": ("Flight",),
    "scenarios.schema.scenario": ("Scenario",),
    "quadsim.controller": ("Command", "Moment"),
    "quadsim.errors": ("QuadsimError",),
    "quadsim.vehicle": ("Vehicle",),
}
_PUBLIC = {name: module for module, names in _PLACES.items() for name in names}
__all__ = [*_PUBLIC]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used."""
    if name not in _PUBLIC:
        raise AttributeError(f"module 'quadsim' has no attribute {name!r}")
    return globals().setdefault(name, getattr(importlib.import_module(_PUBLIC[name]), name))


def __dir__() -> list[str]:
    """The public names, imported or not."""
    return sorted({*globals(), *_PUBLIC})
