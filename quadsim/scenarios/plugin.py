"""User-defined controllers and forces: located by name, imported, called, and adapted to the protocol.

`controller = "my_package.my_module:MyController"` in a file becomes a `Plugin`. `import_plugin` imports its code,
`make_law` calls that and wraps the object in a `PluginController`, which the loop calls as any other controller.
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
from collections.abc import Callable, Mapping, Sequence, Set
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
        table: Any = {"type": controller}
    else:
        table = controller
    if not isinstance(table, Mapping):
        return controller
    name = table.get("type")
    if not isinstance(name, str) or ":" not in name:
        return controller
    folder = table.get("folder")
    if isinstance(folder, str) and (beside / folder).is_dir():
        return {**table, "folder": str((beside / folder).resolve())}
    module, _, _ = name.partition(":")
    package = beside / module.partition(".")[0]
    is_beside = package.is_dir() or package.with_suffix(".py").is_file()
    if is_beside and "folder" not in table:
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
            if isinstance(previous, PluginController):
                previous = previous.law
            self.law.adopt(previous)

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
        state_with_names = state.copy().view(State)
        answer: Any = self.law.step(_copied(now), state_with_names, reference.copy())
        try:
            if not isinstance(answer, Command):
                numbers = _numbers(answer, (self._size,), "it")
                answer = Command(speeds=answer, plan=np.tile(numbers, (self.horizon, 1)))
            return self._checked_command(answer)
        except (AttributeError, TypeError, ValueError) as error:
            what = COMMANDED_NUMBERS[self.commands]
            problem = f"{self.name} answered {answer!r:.100}, neither a Command nor {what}: {error}"
            raise CommandError(problem, time=now.time) from error

    def _checked_command(self, command: Command) -> Command:
        """Return a user's command with plain values and copied arrays.

        Raises:
            AttributeError, TypeError, ValueError: a part of it is not what it must be.
        """
        fallback = operator.index(command.fallback)
        stats = _checked_statistics(command.stats)
        status = printable(command.status)[:200]
        answered_by = printable(command.answered_by)[:200]
        speeds = _numbers(command.speeds, (self._size,), "its speeds")
        plan = _numbers(command.plan, (self.horizon, self._size), "its plan")
        if self._size > N_ROTORS:
            for row in (speeds, *plan):
                length = float(np.linalg.norm(row[N_ROTORS:]))
                if not abs(length - 1.0) < 1e-6:
                    raise ValueError("its attitude must be a unit quaternion")
        if command.inner is not None and self.commands != ROTORS:
            raise ValueError("it commands targets, so the autopilot is its inner loop")
        if command.inner is not None and not command.inner.rate > 0.0:
            raise ValueError("its inner loop must have a positive rate")
        return replace(
            command,
            fallback=fallback,
            stats=stats,
            status=status,
            answered_by=answered_by,
            iterations_by=LAW,
            speeds=speeds,
            plan=plan,
        )


def _copied(now: StepInputs) -> StepInputs:
    """Return the inputs of a step with arrays of their own, so that a user's controller may write to them."""
    motion = now.motion
    if motion is not None:
        motion = motion.read_only()
    return replace(
        now,
        acting=_copy(now.acting),
        attitude=_copy(now.attitude),
        body_rates=_copy(now.body_rates),
        motion=motion,
        unseen=_copy(now.unseen),
    )


def _copy(rows: Array | None) -> Array | None:
    if rows is None:
        return None
    return rows.copy()


def _checked_statistics(stats: Any) -> Statistics:
    """Return statistics as plain numbers, whole where they are counts."""
    if not isinstance(stats, Statistics):
        raise TypeError(f"its stats must be quadsim.Statistics; got {stats!r:.80}")
    values: tuple[Any, ...] = stats
    numbers: list[Any] = []
    for default, value in zip(NO_STATISTICS, values, strict=True):
        if isinstance(default, int):
            numbers.append(operator.index(value))
        else:
            numbers.append(float(numbers_of(value)))
    return Statistics(*numbers)


def _optional(read: Callable[[], Any], default: Any) -> Any:
    """Return what a user's object says, or the default where it says nothing; it is asked once, whatever it raises."""
    try:
        return read()
    except AttributeError:
        return default


def _numbers(numbers: Any, shape: tuple[int, ...], name: str) -> Array:
    """Return a copy of a user's numbers, which messages call `name`; they must have the shape."""
    array = numbers_of(numbers)
    if array.shape != shape:
        raise InputError(f"{name} must have shape {shape}; got {array.shape}")
    return array


def make_law(law: Any, spec: Plugin, vehicle: Vehicle, period: float) -> PluginController:
    """Return the controller of a function law(now, state, reference), a class, an object, or a factory of one."""
    code = _code_of(law)
    is_object = code is type(law)
    if not is_object:
        if isinstance(code, type) or "vehicle" in inspect.signature(code).parameters:
            law = _call(code, spec, {"vehicle": vehicle}, period=period, horizon=spec.horizon)
        else:
            law = _stepping_by(code, spec)
    with user_code(lambda error: InputError(f"{_table(spec)}: {spec.type} cannot be used: {reason_of(error)}")):
        has_step = isinstance(law, Stepping) and callable(law.step)
    if not has_step:
        raise ParameterError("controller", "type", f"{spec.type} ({law!r:.100})", _STEP)
    return PluginController(law, spec.horizon)


def _stepping_by(function: Any, spec: Plugin) -> SimpleNamespace:
    """Return an object whose step is a function law(now, state, reference), with the settings as further arguments."""
    signature = inspect.signature(function)
    try:
        signature.bind(None, None, None, **spec.settings)
    except TypeError as error:
        if inspect.ismethod(function):
            what = "bound method"
        else:
            what = "function"
        given = f"the {what} {function.__qualname__}{signature}"
        raise InputError(f"controller must be {_STEP}; got {given}: {error}") from error
    return SimpleNamespace(step=functools.partial(function, **spec.settings), name=function.__name__)


def make_force(force: Any, spec: PluginForce, vehicle: Vehicle, rng: np.random.Generator) -> Force:
    """Return the force of a function force(time, state), a callable object, or a class of such; see `make_law`."""
    code = _code_of(force)
    if isinstance(code, type):
        is_object = code is type(force)
        if not is_object:
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
    folders = [str(Path.cwd())]
    if spec.folder:
        folders.insert(0, spec.folder)
    top = module.partition(".")[0]
    imported: Any = _import(module, folders, _table(spec))
    file = getattr(sys.modules[top], "__file__", None) or "Python"
    hidden_file = _first_file(top, folders)
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


def _first_file(module: str, folders: Sequence[str]) -> Path | None:
    """Return the file of a module or package in the first of the folders that has one."""
    for folder in folders:
        for name in (f"{module}.py", f"{module}/__init__.py"):
            file = Path(folder, name)
            if file.is_file():
                return file
    return None


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
    _forget_if_changed(module, search)
    before = {*sys.modules}
    try:
        sys.path[:] = search
        sys.dont_write_bytecode = True  # a cached file would stand for the next edit of the same second and size
        with user_code(lambda error: _no_module(module, folders, table, error)):
            return importlib.import_module(module)
    finally:
        sys.path[:] = path
        sys.dont_write_bytecode = writes
        for file in _files_of_users(top, before) - {*_imported}:
            _imported[file] = _digest(file)


def _forget_if_changed(module: str, search: Sequence[str]) -> None:
    """Forget all modules of users if a file of theirs has changed, or `module` is in another file now."""
    top = module.partition(".")[0]
    if getattr(sys.modules.get(top), "__file__", None) not in _imported:
        return
    changed = []
    for file, digest in _imported.items():
        if _digest(file) != digest:
            changed.append(file)
    spec = PathFinder.find_spec(top, search)
    if spec is not None and spec.origin and spec.origin not in _imported:
        changed.append(spec.origin)
    if not changed:
        return
    _log.warning("%s changed: %s is imported again", ", ".join(changed), module)
    for name, loaded in [*sys.modules.items()]:
        if getattr(loaded, "__file__", None) in _imported:
            del sys.modules[name]
    _imported.clear()


def _files_of_users(top: str, before: Set[str]) -> set[str]:
    """Return the files of users' modules that are not among those loaded before, or are in the package `top`."""
    installed = (*_INSTALLED, *OUR_FOLDERS)
    files = set()
    for name, loaded in [*sys.modules.items()]:
        if name not in before or name.partition(".")[0] == top:
            file = getattr(loaded, "__file__", None) or ""
            if file.endswith(".py") and not file.startswith(installed):
                files.add(file)
    return files


def _digest(file: str) -> str:
    """Return the digest of a file; of one that is gone, an empty text."""
    if Path(file).is_file():
        return digest_of(Path(file))
    return ""


def _no_module(module: str, folders: Sequence[str], table: str, error: BaseException) -> InputError:
    """Return the error about a module that cannot be imported; one that is absent, with where it is looked for."""
    problem = f"{table}.type: {module} cannot be imported: {reason_of(error)}"
    absent = isinstance(error, ModuleNotFoundError) and f"{module}.".startswith(f"{error.name}.")
    if absent:
        problem += f"; it is looked for among what is installed, and in {', '.join(folders)}"
    return InputError(problem)


def refer_to(law: object, horizon: int = 1) -> Plugin:
    """Return how a scenario file names a controller or force object: by the place of its code."""
    code: Any = _code_of(law)
    file = getattr(sys.modules.get(code.__module__), "__file__", None)
    folder = None
    if file is not None and not file.startswith(_INSTALLED):
        depth = code.__module__.count(".") + file.endswith("__init__.py")  # of the file below that folder
        folder = str(Path(file).resolve().parents[depth])
    name = code.__qualname__.replace("<locals>.", "").replace("<lambda>", "law")
    settings: dict[str, Any] = {}
    if isinstance(law, functools.partial):
        settings = law.keywords
    return Plugin(type=f"{code.__module__}:{name}", horizon=horizon, folder=folder, settings=settings)


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
    code = law
    if isinstance(law, functools.partial):
        if law.args:
            raise ParameterError("", "controller", law, "a partial with keyword arguments only")
        code = law.func
    if isinstance(code, type) or inspect.isroutine(code):
        return code
    return type(code)


def _table(spec: Plugin | PluginForce) -> str:
    """Return the table of the scenario file that names the code."""
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
