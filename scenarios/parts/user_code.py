"""Controllers and forces passed in as Python objects: classes, functions, or something with a `step`."""

from __future__ import annotations

import functools
import inspect
import sys
import sysconfig
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np

from quadsim.controller import Controller
from quadsim.errors import ParameterError
from quadsim.sim.effects import Force
from quadsim.vehicle import Vehicle
from scenarios.parts.plugin import KINDS, PluginController, make_force, make_law
from scenarios.schema.plugin import ForceSpec, PluginSpec

_INSTALLED: Final = tuple(sysconfig.get_paths()[name] for name in ("stdlib", "platstdlib", "purelib", "platlib"))


def refer_to(law: object, horizon: int) -> PluginSpec:
    """How a scenario file names a controller that was passed in: by the place of its code.

    Args:
        law: a class, a function, a `functools.partial` of one, or an object with a `step`.
        horizon: N, samples of preview.
    """
    code, settings = _code_of(law)
    module = sys.modules.get(code.__module__)
    return PluginSpec(
        type=f"{code.__module__}:{code.__qualname__.replace('<locals>.', '').replace('<lambda>', 'law')}",
        horizon=horizon,
        folder=_folder_of(code.__module__, getattr(module, "__file__", None)),
        settings=settings,
    )


def set_up(law: object, spec: PluginSpec, vehicle: Vehicle, period: float) -> Controller:
    """A controller that was passed in, as the closed loop takes it.

    Args:
        law: see `refer_to`.
        spec: its horizon, and the settings of a class.
        vehicle: the modelled vehicle.
        period: tau_s [s].

    Raises:
        InputError: it has no `step`, or cannot be called as its class is to be.
    """
    if isinstance(law, type | functools.partial) or inspect.isroutine(law):
        return make_law(_code_of(law)[0], spec, vehicle, period)
    if not callable(getattr(law, "step", None)):
        raise ParameterError("", "controller", law, KINDS)
    return PluginController(law, spec.horizon)


def refer_to_force(force: object) -> ForceSpec:
    """How a scenario file names a force that was passed in, by the place of its code; see `refer_to`."""
    spec = refer_to(force, horizon=1)
    return ForceSpec(type=spec.type, folder=spec.folder, settings=spec.settings)


def set_up_force(force: object, vehicle: Vehicle, rng: np.random.Generator) -> Force:
    """A force that was passed in, as the plant takes it.

    Raises:
        InputError: it cannot be called as its kind is to be.
    """
    code, _ = _code_of(force)
    if code is force or isinstance(force, functools.partial):
        return make_force(code, refer_to_force(force), vehicle, rng)
    if not callable(force):
        raise ParameterError("", "forces", force, "a function force(time, state), or a class or an object called so")
    return force


def require_importable(law: object, what: str = "controller") -> None:
    """Refuse a controller or force that other processes cannot import by its place.

    Raises:
        ParameterError: so it is, with what to do about it.
    """
    code, _ = _code_of(law)
    rule = "a class or a function at the top of a module, which worker processes import; "
    if code is not law and not isinstance(law, functools.partial):
        raise ParameterError("", what, law, f"{rule}an object's state is not sent to them: pass its class")
    found: Any = sys.modules.get(code.__module__)
    for part in code.__qualname__.split("."):
        found = getattr(found, part, None)
    if code.__module__ == "__main__" or found is not code:
        where = "the script or notebook" if code.__module__ == "__main__" else "a function"
        raise ParameterError(
            "", "controller", law, f"{rule}this one is defined in {where}: write it to a file of its own"
        )


def _code_of(law: object) -> tuple[Callable[..., Any], dict[str, Any]]:
    """The class or function of a controller, and the settings that a partial binds."""
    if isinstance(law, functools.partial):
        if law.args:
            raise ParameterError("", "controller", law, "a partial with named arguments alone")
        return law.func, dict(law.keywords)
    if isinstance(law, type) or inspect.isroutine(law):
        return law, {}
    return type(law), {}


def _folder_of(module: str, file: str | None) -> str | None:
    """Where a module is to be looked for, unless it is installed."""
    if file is None or any(Path(file).is_relative_to(folder) for folder in _INSTALLED):
        return None
    depth = module.count(".") + (Path(file).name == "__init__.py")
    return str(Path(file).resolve().parents[depth])
