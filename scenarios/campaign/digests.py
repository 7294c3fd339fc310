"""What numbers come from, as digests: our own code, and that of a controller which is not ours."""

from __future__ import annotations

import functools
import sys
from pathlib import Path
from typing import Final

from quadsim.assets import models_dir
from scenarios.parts.controllers import make_controller
from scenarios.parts.foreign_code import digest
from scenarios.parts.plugin import PluginController
from scenarios.parts.vehicle import build_vehicle
from scenarios.schema.scenario import Scenario

_ROOT: Final = Path(__file__).resolve().parents[2]
_PACKAGES: Final = ("quadsim", "mpc", "scenarios")


@functools.cache
def code_digest() -> str:
    """SHA-256 of everything of ours that numbers come from: code, models, scenarios."""
    return digest([*(_ROOT / package for package in _PACKAGES), models_dir()])


def controller_digest(scenario: Scenario) -> str | None:
    """SHA-256 of the code of a plug-in controller: its module, or the whole package that it is in.

    Raises:
        InputError: the controller cannot be made.
    """
    controller = make_controller(scenario.controller, build_vehicle(scenario), scenario.control_period)
    if not isinstance(controller, PluginController):
        return None
    package = controller.module.partition(".")[0]
    file = getattr(sys.modules[package], "__file__", None)
    if file is None:
        return None
    return digest([Path(file).parent if Path(file).name == "__init__.py" else Path(file)])
