"""User-defined controllers and forces: located by name, imported, called, and adapted to the protocol.

`controller = "my_package.my_module:MyController"`
"""

from __future__ import annotations

import functools
import importlib
import inspect
import logging
import operator
import re
import sys
import sysconfig
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import metadata
from importlib.machinery import PathFinder
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any, Final

import numpy as np
from annotated_types import doc

from quadsim import border
from quadsim.border import numbers_of, user_code
from quadsim.controller import (
    COMMANDED_NUMBERS,
    LAW,
    NO_STATISTICS,
    ROTORS,
    TARGET_SIZES,
    Adopting,
    Command,
    Controller,
    Predicting,
    Resetting,
    Statistics,
    StepInputs,
    Stepping,
)
from quadsim.errors import (
    OUR_FOLDERS,
    CommandError,
    InputError,
    ParameterError,
    UnknownNameError,
    described,
    printable,
)
from quadsim.fields import is_plain
from quadsim.mpc.laws import laws
from quadsim.mpc.space import Shape
from quadsim.mpc.tables.controller import ControllerTable, Horizon
from quadsim.outputs import digest_of
from quadsim.sim.effects import Force
from quadsim.state import Array, State
from quadsim.vehicle import N_ROTORS, Vehicle

FORM: Final = "package.module:Class"  # form of a controller's name
ENTRY_POINTS: Final = "quadsim.controllers"
"""Entry-point group under which installed packages announce controllers by short names."""
_NAME: Final = r"[^\W\d]\w*(?:\.[^\W\d]\w*)*"
_STEP: Final = (
    "a class or an object with a method step(now, state, reference), or a function law(now, state, reference)"
)
_INSTALLED: Final = tuple(map(sysconfig.get_path, ("stdlib", "platstdlib", "purelib", "platlib")))
_log: Final = logging.getLogger("quadsim")


@dataclass(frozen=True, kw_only=True)
class _Code:
    folder: Annotated[
        str | None,
        doc("folder searched first for the module, relative to the scenario file; absent: the folder of that file"),
    ] = None
    settings: Annotated[dict[str, Any], doc("further arguments of the call, by name")] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Plugin(ControllerTable, _Code):
    """A user-defined controller, called as MyController(vehicle, period=..., horizon=..., **settings)."""

    type: Annotated[
        str,
        doc("its code, as package.module:Class, or its name among the entry points quadsim.controllers"),
    ] = field(metadata={"json_schema_extra": {"not": {"enum": [*laws()]}}})
    horizon: Annotated[Horizon, doc("[periods] N, samples of the reference passed to a step")] = 50

    @property
    def holds_speeds(self) -> bool:
        """Not known: any of its commands may bring an inner loop."""
        return False

    def __post_init__(self) -> None:
        _check_code(self.type, self.settings, ("vehicle", "period", "horizon"))

    def law(self, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> Controller:
        """See `quadsim.mpc.tables.controller.ControllerTable.law`."""
        return make_law(import_plugin(self), self, vehicle, period)


@dataclass(frozen=True, kw_only=True)
class PluginForce(_Code):
    """User-defined force, called once per physics step; see `quadsim.sim.effects.Force`.

    A function force(time, state, **settings), or a class called as MyForce(vehicle, rng=..., **settings).
    """

    type: Annotated[str, doc("code of the force, as package.module:name")]

    def __post_init__(self) -> None:
        if ":" not in self.type:
            raise ParameterError("", "type", self.type, f"of the form {FORM}")
        _check_code(self.type, self.settings, ("vehicle", "rng", "time", "state"))


def _check_code(place: str, settings: Mapping[str, Any], arguments: tuple[str, ...]) -> None:
    """Reject a malformed place, and settings that are not arguments or cannot be written to a file."""
    if ":" in place and not re.fullmatch(f"{_NAME}:{_NAME}", place):
        raise ParameterError("", "type", place, f"of the form {FORM}")
    for name, value in settings.items():
        if not name.isidentifier() or name in arguments:
            raise ValueError(f"settings.{name} must be the name of an argument other than {', '.join(arguments)}")
        if not is_plain(value):
            rule = "a finite number, a text, true or false, or a list or table of them"
            raise ValueError(f"settings.{name} must be {rule}; got {value}")


def is_plugin(name: str) -> bool:
    """Return whether a text names code or an existing entry point."""
    return ":" in name or name in metadata.entry_points(group=ENTRY_POINTS).names


def located(controller: Any, beside: Path) -> Any:
    """Return a `[controller]` from a file in the folder `beside`, with its own folder made absolute.

    `beside` is the default folder if the module is there.
    """
    if isinstance(controller, str):
        table = {"type": controller}
    else:
        table = controller
    if isinstance(table, Mapping):
        name = table.get("type")
    else:
        name = None
    if not isinstance(name, str) or ":" not in name:
        return controller
    folder = table.get("folder")
    if isinstance(folder, str) and (beside / folder).is_dir():
        return {**table, "folder": str((beside / folder).resolve())}
    first = beside / name.partition(":")[0].partition(".")[0]
    is_beside = "folder" not in table and (first.is_dir() or first.with_suffix(".py").is_file())
    if is_beside:
        return {**table, "folder": str(beside.resolve())}
    return controller


class PluginController:
    """Adapts a law whose `step` returns four speeds or a `Command`, with optional `predict`, `reset` and `adopt`.

    The law receives copies; its commands are checked and copied.

    Attributes:
        law: the user's object.
    """

    iterates: Final = frozenset({LAW})

    def __init__(self, law: Any, horizon: int) -> None:
        self.law = law
        self.horizon = horizon
        kind = type(law).__name__
        with user_code(lambda error: InputError(f"controller: {kind} cannot be used: {reason_of(error)}")):
            self.name = printable(str(_optional(lambda: law.name, kind)))[:200]
            self.solver = printable(str(_optional(lambda: law.solver, "")))[:200]
            self.commands = _optional(lambda: law.commands, ROTORS)
            self._predicting = law if isinstance(law, Predicting) else None
        if not isinstance(self.commands, str) or self.commands not in TARGET_SIZES:
            raise ParameterError("controller", f"{self.name}.commands", self.commands, f"one of {[*TARGET_SIZES]}")
        self._size = TARGET_SIZES[self.commands]
        self._warned = False

    @property
    def infeasible_period(self) -> object:
        """The first problem without an answer, a `quadsim.mpc.InfeasiblePeriod`, if the law keeps one."""
        try:
            with user_code(lambda error: InputError(reason_of(error))):
                return _optional(lambda: self.law.infeasible_period, None)
        except InputError as error:  # the flight is complete and must not be lost
            if not self._warned:
                _log.warning("no diagnosis: infeasible_period raised %s", error)
            self._warned = True
            return None

    def reset(self, speeds: Array) -> None:
        """See `quadsim.controller.Controller.reset`; raises InputError if the law's raises."""
        what = f"controller: {self.name}.reset cannot be called"
        with user_code(lambda error: InputError(f"{what}: {reason_of(error)}")):
            if isinstance(self.law, Resetting):
                self.law.reset(speeds.copy())

    def adopt(self, previous: object) -> None:
        """See `quadsim.controller.Adopting`; from another user's law to the law itself."""
        if isinstance(self.law, Adopting):
            self.law.adopt(previous.law if isinstance(previous, PluginController) else previous)

    def predict(self, states: Array, plans: Array) -> Array | None:
        """See `quadsim.controller.Predicting`; raises InputError if the law's answer has another shape."""
        if self._predicting is None:
            return None
        predicted = self._predicting.predict(states.copy(), plans.copy())
        return _numbers(predicted, (*plans.shape[:2], states.shape[1]), f"{self.name}.predict")

    def foresee(self, states: Array, commands: Array) -> Array | None:
        """See `quadsim.controller.Foreseeing`; by the law's `problem` (`quadsim.mpc.Problem`) if it cannot predict."""
        from quadsim.mpc.problem.ocp import Problem
        from quadsim.mpc.problem.paper import rollout

        problem = _optional(lambda: self.law.problem, None)
        if self._predicting is not None or self.commands != ROTORS or not isinstance(problem, Problem):
            return None
        if problem.model.A.shape[0] != states.shape[1] or problem.model.B.shape[1] != commands.shape[1]:
            return None
        return rollout(problem.model, states, commands[:, None])[:, 0]

    def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
        """See `quadsim.controller.Controller.step`; raises CommandError if the answer is not a command."""
        acting, attitude, rates, unseen = (
            None if rows is None else rows.copy() for rows in (now.acting, now.attitude, now.body_rates, now.unseen)
        )
        if now.motion is None:
            motion = None
        else:
            motion = now.motion.read_only()
        given = replace(now, acting=acting, attitude=attitude, body_rates=rates, motion=motion, unseen=unseen)
        named = state.copy().view(State)
        answer: Any = self.law.step(given, named, reference.copy())
        try:
            if not isinstance(answer, Command):
                answer = Command(speeds=answer, plan=np.tile(_numbers(answer, (self._size,), "it"), (self.horizon, 1)))
            parts: dict[str, Any] = {"fallback": operator.index(answer.fallback), "stats": _checked(answer.stats)}
            parts |= {name: printable(getattr(answer, name))[:200] for name in ("status", "answered_by")}
            parts["iterations_by"] = LAW
            parts["speeds"] = _numbers(answer.speeds, (self._size,), "its speeds")
            parts["plan"] = _numbers(answer.plan, (self.horizon, self._size), "its plan")
            if self._size > N_ROTORS:
                for row in (parts["speeds"], *parts["plan"]):
                    if not abs(float(np.linalg.norm(row[N_ROTORS:])) - 1.0) < 1e-6:
                        raise ValueError("its attitude must be a unit quaternion")
            if answer.inner is not None and self.commands != ROTORS:
                raise ValueError("it commands targets, so the autopilot is its inner loop")
            if answer.inner is not None and not answer.inner.rate > 0.0:
                raise ValueError("its inner loop must have a positive rate")
            return replace(answer, **parts)
        except (AttributeError, TypeError, ValueError) as error:
            what = COMMANDED_NUMBERS[self.commands]
            problem = f"{self.name} answered {answer!r:.100}, neither a Command nor {what}: {error}"
            raise CommandError(problem, time=now.time) from error


def _checked(stats: Any) -> Statistics:
    """Return statistics as plain numbers, whole where they are counts."""
    if not isinstance(stats, Statistics):
        raise TypeError(f"its stats must be quadsim.Statistics; got {stats!r:.80}")
    values: tuple[Any, ...] = stats
    numbers: list[Any] = []
    for usual, value in zip(NO_STATISTICS, values, strict=True):
        numbers.append(operator.index(value) if isinstance(usual, int) else float(numbers_of(value)))
    return Statistics(*numbers)


def _optional(read: Callable[[], Any], default: Any) -> Any:
    """Return what a user's object says, or the default where it says nothing; it is asked once, whatever it raises."""
    try:
        return read()
    except AttributeError:
        return default


def _numbers(numbers: Any, shape: tuple[int, ...], name: str) -> Array:
    array = numbers_of(numbers)
    if array.shape != shape:
        raise InputError(f"{name} must have shape {shape}; got {array.shape}")
    return array


def make_law(law: Any, spec: Plugin, vehicle: Vehicle, period: float) -> PluginController:
    """Return the controller of a function law(now, state, reference), a class, an object, or a factory of one."""
    if (code := _code_of(law)) is not type(law):
        if isinstance(code, type) or "vehicle" in inspect.signature(code).parameters:
            law = _call(code, spec, {"vehicle": vehicle}, period=period, horizon=spec.horizon)
        else:
            try:
                inspect.signature(code).bind(None, None, None, **spec.settings)
            except TypeError as error:
                if inspect.ismethod(code):
                    what = "bound method"
                else:
                    what = "function"
                given = f"the {what} {code.__qualname__}{inspect.signature(code)}"
                raise InputError(f"controller must be {_STEP}; got {given}: {error}") from error
            law = SimpleNamespace(step=functools.partial(code, **spec.settings), name=code.__name__)
    with user_code(lambda error: InputError(f"{_table(spec)}: {spec.type} cannot be used: {reason_of(error)}")):
        steps = isinstance(law, Stepping) and callable(law.step)
    if not steps:
        raise ParameterError("controller", "type", f"{spec.type} ({law!r:.100})", _STEP)
    return PluginController(law, spec.horizon)


def make_force(force: Any, spec: PluginForce, vehicle: Vehicle, rng: np.random.Generator) -> Force:
    """Return the force of a function force(time, state), a callable object, or a class of such; see `make_law`."""
    if isinstance(code := _code_of(force), type):
        if code is not type(force):
            force = _call(code, spec, {"vehicle": vehicle}, rng=rng)
    else:
        _call(inspect.signature(code).bind, spec, dict.fromkeys(("time", "state")))
        force = functools.update_wrapper(functools.partial(code, **spec.settings), code)
    if not callable(force):
        raise ParameterError("forces", "type", spec.type, "a function force(time, state), or a class of such objects")
    return force


def _call(call: Any, spec: Plugin | PluginForce, arguments: dict[str, Any], **given: Any) -> Any:
    """Call with these arguments and the settings; an exception becomes a message about them."""
    called = ", ".join([*arguments, *given, *spec.settings])
    what = f"{_table(spec)}: {spec.type} cannot be called with {called}"
    with user_code(lambda error: InputError(f"{what}: {reason_of(error)}"), passing=(InputError,)):
        return call(*arguments.values(), **given, **spec.settings)


def import_plugin(spec: Plugin | PluginForce) -> Any:
    """Import a scenario's code from installed packages, the spec's folder or the working directory; log its source.

    Raises:
        InputError: it does not exist, or its module cannot be imported.
    """
    if ":" in spec.type:
        place = spec.type
    else:
        place = metadata.entry_points(group=ENTRY_POINTS)[spec.type].value
    module, _, attribute = place.partition(":")
    folders = [*filter(None, [spec.folder]), str(Path.cwd())]
    top = module.partition(".")[0]
    imported: Any = _import(module, folders, _table(spec))
    file = getattr(sys.modules[top], "__file__", None) or "Python"
    files = [Path(folder, name) for folder in folders for name in (f"{top}.py", f"{top}/__init__.py")]
    hidden_file = next(filter(Path.is_file, files), None)
    if hidden_file is not None and hidden_file.resolve() != Path(file).resolve():
        raise InputError(
            f"{_table(spec)}.type: {hidden_file} is hidden by another module {top}, from {file}; rename it"
        )
    _log.info("imported %s from %s", module, getattr(imported, "__file__", None) or file)
    for part in attribute.split("."):
        if not hasattr(imported, part):
            names = []
            for name, value in vars(imported).items():
                if callable(value) and not name.startswith("_"):
                    names.append(name)
            raise UnknownNameError(f"{_table(spec)}.type in {getattr(imported, '__name__', module)}", part, names)
        imported = getattr(imported, part)
    return imported


_imported: Final[dict[str, str]] = {}
"""Digests of the files that user modules were imported from here, with those that they imported."""


def _import(module: str, folders: Sequence[str], table: str) -> Any:
    """Import a user's module by its content: if a file has changed, or it is another one now, all are imported anew.

    Raises:
        InputError: it cannot be imported.
    """
    path = list(sys.path)
    top = module.partition(".")[0]
    writes = sys.dont_write_bytecode
    search = [*path, *folders]  # last, so that installed modules take precedence
    importlib.invalidate_caches()
    if getattr(sys.modules.get(top), "__file__", None) in _imported:
        spec = PathFinder.find_spec(top, search)
        changed = [file for file, digest in _digests(_imported).items() if digest != _imported[file]]
        changed += [spec.origin] if spec is not None and spec.origin and spec.origin not in _imported else []
        if changed:
            _log.warning("%s changed: %s is imported again", ", ".join(changed), module)
            for name in [name for name, held in sys.modules.items() if getattr(held, "__file__", None) in _imported]:
                del sys.modules[name]
            _imported.clear()
    before = {*sys.modules}
    try:
        sys.path[:] = search
        sys.dont_write_bytecode = True  # a cached file would stand for the next edit of the same second and size
        with user_code(lambda error: _no_module(module, folders, table, error)):
            return importlib.import_module(module)
    finally:
        sys.path[:] = path
        sys.dont_write_bytecode = writes
        new = [name for name in sys.modules if name not in before or name.partition(".")[0] == top]
        files = {getattr(sys.modules[name], "__file__", None) or "" for name in new}
        installed = (*_INSTALLED, *OUR_FOLDERS)
        users = []
        for file in files - {*_imported}:
            if file.endswith(".py") and not file.startswith(installed):
                users.append(file)
        _imported.update(_digests(users))


def _digests(files: Iterable[str]) -> dict[str, str]:
    """Return the digest of each file; of one that is gone, an empty text."""
    return {file: digest_of(Path(file)) if Path(file).is_file() else "" for file in files}


def _no_module(module: str, folders: Sequence[str], table: str, error: BaseException) -> InputError:
    absent = isinstance(error, ModuleNotFoundError) and f"{module}.".startswith(f"{error.name}.")
    if absent:
        where = f"; it is looked for among what is installed, and in {', '.join(folders)}"
    else:
        where = ""
    return InputError(f"{table}.type: {module} cannot be imported: {reason_of(error)}{where}")


def refer_to(law: object, horizon: int = 1) -> Plugin:
    """Return how a scenario file names a controller or force object: by the place of its code."""
    code: Any = _code_of(law)
    file = getattr(sys.modules.get(code.__module__), "__file__", None)
    folder = None
    if file is not None and not file.startswith(_INSTALLED):
        folder = str(Path(file).resolve().parents[code.__module__.count(".") + file.endswith("__init__.py")])
    place = f"{code.__module__}:{code.__qualname__.replace('<locals>.', '').replace('<lambda>', 'law')}"
    if isinstance(law, functools.partial):
        settings = law.keywords
    else:
        settings = {}
    return Plugin(type=place, horizon=horizon, folder=folder, settings=settings)


def require_importable(law: object, what: str = "controller") -> None:
    """Reject a controller or force that other processes cannot import by its place."""
    code: Any = _code_of(law)
    resolved: Any = sys.modules.get(code.__module__)
    for part in code.__qualname__.split("."):
        resolved = getattr(resolved, part, None)
    if code is type(law) or code.__module__ == "__main__" or resolved is not code:
        rule = "a class or a function at the top level of a module other than the script, so that workers can import it"
        raise ParameterError("", what, law, rule)


def _code_of(law: Any) -> Any:
    """Return the class or function of a law, directly or in a partial; the class of an object."""
    if isinstance(law, functools.partial):
        code = law.func
    else:
        code = law
    if isinstance(law, functools.partial) and law.args:
        raise ParameterError("", "controller", law, "a partial with keyword arguments only")
    if isinstance(code, type) or inspect.isroutine(code):
        return code
    return type(code)


def _table(spec: Plugin | PluginForce) -> str:
    if isinstance(spec, PluginForce):
        return "forces"
    return "controller"


def reason_of(error: BaseException) -> str:
    """Format an exception in one line, with the user's line that raised it."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    text = described(error)
    ours = last.filename in (__file__, border.__file__, inspect.__file__, importlib.__file__)
    ours = ours or "<frozen" in last.filename
    if ours or isinstance(error, SyntaxError):
        return text
    return f"{text} ({last.filename}, line {last.lineno})"
