"""Plug-in controllers: found by the location of their code, called, and fitted to the protocol."""

from __future__ import annotations

import difflib
import functools
import importlib
import inspect
import math
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mpc.handover import hand_over
from quadsim.controller import Command, Controller, Moment
from quadsim.errors import CommandError, InputError, ParameterError, printable
from quadsim.sim.effects import Force
from quadsim.state import Array
from quadsim.vehicle import N_ROTORS, Vehicle
from scenarios.parts.foreign_code import announce, folders_of, searched
from scenarios.schema.plugin import GIVEN, ForceSpec, PluginSpec

_WHOLE, _REAL = ("iterations", "active", "fallback"), ("slack", "primal_residual", "dual_residual", "solve_s")
"""What else a command has: whole numbers, and numbers."""
STEP = ("now", "state", "reference")
"""What the arguments of a controller's step are called, and of a function that is one."""
KINDS = "a class, a function law(now, state, reference), or an object with a method step(now, state, reference)"
"""What a controller may be."""
_LONGEST = 200  # characters of a name or status


class PluginController:
    """A controller with a `step` alone, or more, as the testbed wants it.

    What it lacks is filled in: `name` by its class's, `solver` by none, `reset` by nothing.  A step may answer with
    four speeds instead of a `Command`.  It gets copies of its inputs, and its answers are copied.  `predict` is
    there where it has one.

    Args:
        law: has step(now, state, reference).
        horizon: N, samples of preview.
    """

    predict: Callable[[Array, Array], Array]

    def __init__(self, law: Any, horizon: int) -> None:
        self._law, self.horizon = law, horizon
        if hasattr(law, "predict"):
            self.predict = self._predict

    @property
    def name(self) -> str:
        """What it calls itself, or what its class is called."""
        return _line(getattr(self._law, "name", type(self._law).__name__))

    @property
    def module(self) -> str:
        """The module that its code is in."""
        return self._law.module if isinstance(self._law, _Function) else type(self._law).__module__

    @property
    def solver(self) -> str:
        """Its QP solver; empty where it names none."""
        return _line(getattr(self._law, "solver", ""))

    @property
    def unanswered(self) -> object:
        """The first problem without an answer, an `mpc.Unanswered`, where it keeps one."""
        return getattr(self._law, "unanswered", None)

    def reset(self, speeds: Array) -> None:
        """See `quadsim.controller.Controller.reset`."""
        if hasattr(self._law, "reset"):
            self._law.reset(speeds.copy())

    def adopt(self, previous: object) -> None:
        """See `quadsim.controller.Controller`; one's own law before is handed over itself."""
        hand_over(self._law, previous._law if isinstance(previous, PluginController) else previous)

    def step(self, now: Moment, state: Array, reference: Array) -> Command:
        """See `quadsim.controller.Controller.step`.

        Raises:
            CommandError: what it answered is neither a command nor four speeds, or a command with parts of other types
                or shapes.
        """
        acting = None if now.acting is None else now.acting.copy()
        answer = self._law.step(replace(now, acting=acting), state.copy(), reference.copy())
        if isinstance(answer, Command):
            return self._checked(answer, now.time)
        speeds = _numbers(answer)
        if speeds is None or speeds.shape != (N_ROTORS,):
            problem = f"{self.name} answered {answer!r:.100}, which is neither a Command nor {N_ROTORS} rotor speeds"
            raise CommandError(problem, time=now.time)
        return Command(speeds=speeds, plan=np.tile(speeds, (self.horizon, 1)))

    def _predict(self, states: Array, plans: Array) -> Array:
        """See `quadsim.controller.Controller.predict`.

        Raises:
            InputError: what it gives has another shape.
        """
        answer = self._law.predict(states.copy(), plans.copy())
        shape = (*plans.shape[:2], states.shape[1])
        predicted = _numbers(answer)
        if predicted is None or predicted.shape != shape:
            given = type(answer).__name__ if predicted is None else f"numbers of shape {predicted.shape}"
            raise InputError(f"controller.type: predict of {self.name} must give numbers of shape {shape}; got {given}")
        return predicted

    def _checked(self, answer: Command, time: float) -> Command:
        """A copy of a command, whose arrays its law may write over, with everything of its type and shape."""

        def refuse(name: str, rule: str) -> CommandError:
            given = f"{getattr(answer, name)!r:.80}"
            problem = f"{self.name} answered a Command whose {name} must be {rule}; got {given}"
            return CommandError(problem, time=time)

        speeds, plan = _numbers(answer.speeds), _numbers(answer.plan)
        if speeds is None or speeds.shape != (N_ROTORS,):
            raise refuse("speeds", f"{N_ROTORS} numbers")
        if plan is None or plan.shape != (self.horizon, N_ROTORS):
            raise refuse("plan", f"numbers of shape {(self.horizon, N_ROTORS)}")
        if not isinstance(answer.status, str):
            raise refuse("status", "a text")
        for name in _WHOLE:
            if not isinstance(getattr(answer, name), int | np.integer):
                raise refuse(name, "a whole number")
        for name in _REAL:
            if not isinstance(getattr(answer, name), int | float | np.integer | np.floating):
                raise refuse(name, "a number")
        residual = None if answer.sqp is None else _numbers(answer.sqp)
        if answer.sqp is not None and (residual is None or residual.shape != (2,)):
            raise refuse("sqp", "None, or two numbers")
        rate = getattr(answer.inner, "rate", None)
        if answer.inner is not None and not (isinstance(rate, int | float) and 0.0 < rate < math.inf):
            raise refuse("inner", "None, or an inner loop with a positive rate")
        return replace(answer, speeds=speeds, plan=plan, status=_line(answer.status))


def _line(text: object) -> str:
    """A name or a status as files and terminals can hold it."""
    return printable(str(text))[:_LONGEST]


def _numbers(given: Any) -> Array | None:
    """A copy as an array of numbers, or None where it holds anything else."""
    try:
        return np.array(given, float)
    except (TypeError, ValueError):
        return None


@dataclass(frozen=True)
class _Function:
    """A function as a law without memory."""

    step: Callable[..., Any]
    name: str
    module: str


def import_plugin(spec: PluginSpec) -> None:
    """Import the module that a controller is in; see `build_plugin`.

    Raises:
        InputError: there is none, or it cannot be imported.
    """
    code = announce(spec)
    folders = folders_of(spec)
    with searched(folders):
        _import(spec.type, code.module, folders)


def build_plugin(spec: PluginSpec, vehicle: Vehicle, period: float) -> Controller:
    """Import a controller and call it.

    What is to run is logged to `foreign_code.LOGGER` first.  Its module is looked for in the spec's folder, the
    working directory, then among what is installed; these two stand first on the path while it is imported and called,
    and no longer.

    Args:
        spec: names it.
        vehicle: the modelled vehicle.
        period: tau_s [s].

    Raises:
        InputError: there is no such module or class, it cannot be imported, it does not take the settings, refuses
            them by a ValueError, or has no `step`.  Any other exception of its own code passes, traceback and all.
    """
    code = announce(spec)
    folders = folders_of(spec)
    with searched(folders):
        module = _import(spec.type, code.module, folders)
        return make_law(_find(spec.type, module, code.attribute), spec, vehicle, period)


def make_law(code: Callable[..., Any], spec: PluginSpec, vehicle: Vehicle, period: float) -> PluginController:
    """A controller of a function law(now, state, reference), or of a class, which is called; see `build_plugin`."""
    attribute = getattr(code, "__qualname__", spec.type.partition(":")[2])
    if inspect.isfunction(code) and tuple(inspect.signature(code).parameters)[:3] == STEP:
        step = functools.partial(code, **spec.settings)
        return PluginController(_Function(step, code.__name__, code.__module__), spec.horizon)
    if inspect.isfunction(code) or inspect.ismethod(code):
        takes = inspect.signature(code).parameters
        if not any(each.name in GIVEN or each.kind is each.VAR_KEYWORD for each in takes.values()):
            what = "the bound method" if inspect.ismethod(code) else "the function"
            raise InputError(f"controller must be {KINDS}; got {what} {attribute}({', '.join(takes)})")
    given = dict(zip(GIVEN, (vehicle, period, spec.horizon), strict=True)) | spec.settings
    _check_call(attribute, code, given)
    try:
        law = code(given.pop("vehicle"), **given)
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"controller.settings: {attribute} refuses them: {_reason(error)}") from error
    if not callable(getattr(law, "step", None)):
        rule = f"something with a method step(now, state, reference); {attribute}(...) gave {type(law).__name__}"
        raise ParameterError("controller", "type", spec.type, rule)
    return PluginController(law, spec.horizon)


def build_force(spec: ForceSpec, vehicle: Vehicle, rng: np.random.Generator) -> Force:
    """Import a force of one's own; a class is called.

    Raises:
        InputError: there is no such code, it cannot be imported, or it does not take the settings.
    """
    code = announce(spec)
    folders = folders_of(spec)
    with searched(folders):
        module = _import(spec.type, code.module, folders, "forces")
        return make_force(_find(spec.type, module, code.attribute, "forces"), spec, vehicle, rng)


def make_force(code: Callable[..., Any], spec: ForceSpec, vehicle: Vehicle, rng: np.random.Generator) -> Force:
    """A force of a function force(time, state), or of a class, which is called; see `build_force`."""
    attribute = getattr(code, "__qualname__", spec.type.partition(":")[2])
    if not isinstance(code, type):
        _check_call(attribute, code, {"time": 0.0, "state": None} | spec.settings, "forces", ("time", "state"))
        return functools.update_wrapper(functools.partial(code, **spec.settings), code)
    given = {"vehicle": vehicle, "rng": rng} | spec.settings
    _check_call(attribute, code, given, "forces", ("vehicle", "rng"))
    try:
        force = code(given.pop("vehicle"), **given)
    except ValueError as error:
        raise InputError(f"forces.settings: {attribute} refuses them: {_reason(error)}") from error
    if not callable(force):
        rule = f"a class with a method __call__(time, state), and {attribute} has none"
        raise ParameterError("forces", "type", spec.type, rule)
    return force


def _import(name: str, module: str, folders: list[str], table: str = "controller") -> Any:
    try:
        found = importlib.import_module(module)
    except Exception as error:
        parts = module.split(".")
        own = {".".join(parts[: i + 1]) for i in range(len(parts))}
        if isinstance(error, ModuleNotFoundError) and error.name in own:
            rule = (
                f"of a module that there is: {error.name!r} is not where the scenario file is, not in the working "
                f"directory {folders[-1]}, and not installed"
            )
            raise ParameterError(table, "type", name, rule) from None
        raise InputError(f"{table}.type: module {module!r} cannot be imported: {_reason(error)}") from error
    _check_origin(module, found, folders, table)
    return found


def _check_origin(module: str, found: Any, folders: list[str], table: str) -> None:
    """Refuse a module of the same name that was imported from elsewhere before."""
    file = getattr(found, "__file__", None)
    relative = Path(*module.split("."))
    for folder in folders:
        here = [Path(folder) / relative.with_suffix(".py"), Path(folder) / relative / "__init__.py"]
        wanted = next((path for path in here if path.is_file()), None)
        if wanted is not None:
            if file is not None and not wanted.samefile(file):
                raise InputError(
                    f"{table}.type: {wanted} cannot be imported: a module {module!r} from {file} is loaded already; "
                    "rename one of them"
                )
            return


def _find(name: str, module: Any, attribute: str, table: str = "controller") -> Callable[..., Any]:
    found = module
    for part in attribute.split("."):
        if not hasattr(found, part):
            names = sorted(key for key, value in vars(found).items() if callable(value) and not key.startswith("_"))
            near = difflib.get_close_matches(part, names, n=1)
            guess = f"; did you mean {near[0]!r}?" if near else ""
            there = f" (there are: {', '.join(names)})" if names else ""
            where = getattr(found, "__name__", attribute)
            raise InputError(f"{table}.type: {where!r} has no {part!r}{guess}{there}")
        found = getattr(found, part)
    if not callable(found):
        raise ParameterError(table, "type", name, f"a class or a function; {attribute} is {found!r:.100}")
    return found


def _check_call(
    attribute: str,
    factory: Callable[..., Any],
    given: dict[str, Any],
    table: str = "controller",
    always: tuple[str, ...] = GIVEN,
) -> None:
    """Refuse settings that code does not take, and code that does not take what all are given."""
    try:
        signature = inspect.signature(factory)
    except (TypeError, ValueError):  # of compiled code, which has no signature
        return
    first = always[0]
    parameters = list(signature.parameters.values())
    named = {name: value for name, value in given.items() if name != first}
    if not any(each.kind is each.VAR_KEYWORD for each in parameters):
        takes = [each.name for each in parameters[1:] if each.kind in (each.POSITIONAL_OR_KEYWORD, each.KEYWORD_ONLY)]
        for name in named:
            if name not in takes:
                near = difflib.get_close_matches(name, set(takes) - set(always), n=1)
                guess = f"; did you mean {near[0]!r}?" if near and name not in always else ""
                field = "type" if name in always else "settings"
                what = f"{attribute} takes no argument {name!r}{guess} (after the {first} it takes: {', '.join(takes)})"
                raise InputError(f"{table}.{field}: {what}")
    try:
        signature.bind(given[first], **named)
    except TypeError as error:
        raise InputError(f"{table}.settings: {attribute} cannot be called with them: {error}") from None


def _reason(error: BaseException) -> str:
    """An exception in one line, with the line of code that it is from."""
    text = " ".join(f"{type(error).__name__}: {error}".split())
    if isinstance(error, SyntaxError):  # which names its line itself
        return text
    frames = traceback.extract_tb(error.__traceback__)
    return f"{text} ({frames[-1].filename}, line {frames[-1].lineno})" if frames else text
