"""The errors that users meet: the value given, the values allowed, and a remedy.

Two families have one root.  An `InputError` is for the user to correct (exit status 2). A `FlightError` happens in
flight: it ends the flight, is recorded as its reason, and gives exit status 1.
"""

from __future__ import annotations

import difflib
import os
import traceback
import unicodedata
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Final

_TRACEBACK_LINES: Final = 20  # lines kept of the traceback that ended a flight
_LONGEST: Final = 500  # characters kept of its message
_LONGEST_LIST: Final = 150  # characters of a list of names
OUR_FOLDERS: Final = (f"{Path(__file__).parent}{os.sep}",)
_HIDDEN: Final = frozenset({"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"})
"""Unicode categories that control a terminal or are invisible: controls, formats such as direction, surrogates."""


def printable(text: str, *, keep: str = "") -> str:
    r"""Escape the characters that control a terminal, e.g. as `\x1b`, except those in `keep`."""
    if text.isprintable():
        return text
    escaped = []
    for character in text:
        hidden = character not in keep and unicodedata.category(character) in _HIDDEN
        if hidden:
            escaped.append(ascii(character)[1:-1])
        else:
            escaped.append(character)
    return "".join(escaped)


class QuadsimError(Exception):
    """Root of all errors raised on purpose; `exit_status` is what the command line returns for it.

    Errors survive pickling between processes, whatever arguments their constructors need.

    Examples:
        >>> import quadsim
        >>> try:
        ...     quadsim.load("hovver")
        ... except quadsim.QuadsimError as error:
        ...     print(error.exit_status, str(error)[:44])
        2 no scenario named 'hovver'; did you mean 'ho
    """

    exit_status = 2
    result: object = None
    """The result obtained despite the error, e.g. the flight whose film failed."""

    def __reduce__(self) -> tuple[object, ...]:
        return _restore, (type(self), self.args, self.__dict__)


class InputError(QuadsimError, ValueError):
    """The input is invalid; the message tells the user how to correct it."""


class ParameterError(InputError):
    """A parameter is outside its allowed range.

    `owner` is the object it belongs to, e.g.  `vehicle`, empty for a command-line option; `rule` completes the sentence
    "must be ...".
    """

    def __init__(self, owner: str, name: str, value: object, rule: str) -> None:
        full_name = name
        if owner:
            full_name = f"{owner}.{name}"
        super().__init__(f"{full_name} must be {rule}; got {value!r}")
        self.owner = owner
        self.name = name
        self.value = value
        self.rule = rule


class ExportError(InputError):
    """The controller has no C implementation; `reason` completes "... cannot be exported: ..."."""

    def __init__(self, reason: str) -> None:
        super().__init__(f"this scenario's controller cannot be exported: {reason}")
        self.reason = reason


class UnknownNameError(InputError):
    """A name outside a known set.

    The message lists the set and the closest name, or those in `meant`: other spellings of the same thing.  Of a long
    set it lists some names, unless it is to list all: `whole`.  Of a name that an earlier version had, it tells the
    `successor`.
    """

    def __init__(
        self,
        kind: str,
        name: str,
        allowed: Iterable[str],
        hint: str = "",
        meant: Sequence[str] = (),
        successor: str | None = None,
        *,
        whole: bool = False,
    ) -> None:
        self.kind = kind
        self.name = name
        self.allowed = tuple(sorted(allowed))
        if successor is not None:
            super().__init__(f"the {kind} {name!r} was removed: use {successor!r}")
            return
        guess = ""
        near = meant or difflib.get_close_matches(name, self.allowed, n=1)
        if near:
            guess = f"; did you mean {' and '.join(map(repr, near))}?"
        tail = ""
        if hint:
            tail = f"; {hint}"
        listed = f"there are: {', '.join(self.allowed)}"
        if len(listed) > _LONGEST_LIST:
            some = [*self.allowed]
            if not whole:
                some = [*self.allowed[: max(1, listed[:_LONGEST_LIST].count(",") - 1)], "..."]
            listed = f"there are {len(self.allowed)}: {', '.join(some)}"
        super().__init__(f"no {kind} named {name!r}{guess} ({listed}){tail}")


class FileError(InputError):
    """A file that is missing, unreadable or malformed."""

    def __init__(self, path: Path | str, problem: str) -> None:
        super().__init__(f"{printable(str(path))}: {problem}")
        self.path = Path(path)
        self.problem = problem


class MissingPackageError(InputError):
    """A feature needs an optional package that is not installed; the message names it."""

    def __init__(self, what: str, package: str, *, extra: str) -> None:
        super().__init__(f"{what} needs the package {package!r}: pip install 'quadsim[{extra}]'")
        self.what = what
        self.package = package
        self.extra = extra


class MissingProgramError(InputError):
    """A feature needs a program that is not installed; the message names it."""

    def __init__(self, what: str, program: str, *, packages: str) -> None:
        super().__init__(f"{what} needs {program!r}: apt-get install --no-install-recommends {packages}")
        self.what = what
        self.program = program
        self.packages = packages


class OutputError(QuadsimError, OSError):
    """Results cannot be written, e.g. to a read-only directory or a full disk; nothing partial is left."""

    def __init__(self, path: Path | str, problem: str) -> None:
        super().__init__(f"cannot write {printable(str(path))}: {problem}")
        self.path = Path(path)
        self.problem = problem


class RenderingUnavailableError(QuadsimError):
    """This machine can render with neither EGL nor OSMesa."""

    def __init__(self, tried: dict[str, str]) -> None:
        details = "; ".join(f"{backend}: {problem}" for backend, problem in tried.items())
        super().__init__(
            f"no off-screen OpenGL on this machine ({details}). Install one with "
            "'apt-get install --no-install-recommends libegl1 libgl1 libgl1-mesa-dri' (or 'libosmesa6'), "
            "or run with --no-video"
        )
        self.tried = tried


class ViewerUnavailableError(QuadsimError):
    """The rerun viewer cannot start here."""


class FlightError(QuadsimError):
    """An error that ends a flight at a simulated time [s] and becomes its recorded reason."""

    exit_status = 1

    def __init__(self, message: str, *, time: float) -> None:
        super().__init__(f"at t = {time:.3f} s: {printable(message)}")
        self.time = time


class DivergenceError(FlightError):
    """The plant's state became non-finite or implausible, or MuJoCo reported a numerical warning."""


class LostError(FlightError):
    """The vehicle exceeds one of the flight's loss criteria; see `quadsim.flight.phase.CRITERIA`."""

    def __init__(self, criterion: str, quantity: str, unit: str, *, value: float, limit: float, time: float) -> None:
        message = f"lost: {quantity} {value:.5g} {unit}, beyond lost.{criterion} = {limit:g} {unit}"
        super().__init__(message, time=time)
        self.criterion = criterion
        self.value = value
        self.limit = limit


class CommandError(FlightError):
    """A command was rejected before it reached the plant: wrong shape, non-finite, or above any rotor's speed."""


class ForceError(FlightError):
    """A user-defined force is not six finite numbers."""


class PlanExhaustedError(FlightError):
    """The solver failed and no step of the last good plan is left to hold."""


class RaisedError(FlightError):
    """The controller or a force raised an exception, or exited; `traceback` has its last lines, from the user's on."""

    def __init__(self, what: str, error: BaseException, *, time: float) -> None:
        start = _of_user(error.__traceback__)
        lines = "".join(traceback.format_exception(type(error), error, start)).splitlines()
        text = "".join(traceback.format_exception_only(error)).split("\n")[0]
        super().__init__(f"{what} raised {text}"[:_LONGEST], time=time)
        self.traceback = tuple(printable(line)[:_LONGEST] for line in lines[-_TRACEBACK_LINES:])


class InterruptedFlightError(FlightError):
    """The user pressed Ctrl-C."""

    def __init__(self, *, time: float) -> None:
        super().__init__("interrupted (Ctrl-C)", time=time)


def failure_line(error: BaseException) -> str:
    """Return why something was not made, in one line: `failed: ValueError: no`."""
    if isinstance(error, OutputError):
        text = error.problem  # without its path, which is that of what was to be made
    elif isinstance(error, QuadsimError):
        text = str(error)
    else:
        text = described(error)
    return f"failed: {printable(' '.join(text.split()))}"[:_LONGEST]


def described(error: BaseException) -> str:
    """Return an exception in one printable line, whatever its own `__str__` does."""
    try:
        text = f"{type(error).__name__}: {error}"
    except Exception:
        text = f"{type(error).__name__}, whose text cannot be read"
    return printable(" ".join(text.split()))


def _of_user(frames: TracebackType | None) -> TracebackType | None:
    """Return a traceback from the first frame on that is not in our code; the whole of it where all are."""
    first = frames
    while first is not None and first.tb_frame.f_code.co_filename.startswith(OUR_FOLDERS):
        first = first.tb_next
    if first is None:
        return frames
    return first


def _restore(kind: type[QuadsimError], arguments: tuple[object, ...], values: dict[str, object]) -> QuadsimError:
    """Restore an error's message and attributes without calling its constructor."""
    error = kind.__new__(kind)
    error.args = arguments
    error.__dict__.update(values)
    return error
