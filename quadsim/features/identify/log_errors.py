"""The errors of logs: what libraries, files and their values raise, as quadsim's own; and what a log states of itself.

`reading_errors` is about each reader of a format, `fitting_errors` about checks, fit and prediction.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from quadsim.errors import FileError, InputError, MissingPackageError, QuadsimError

_LARGEST_STATED: Final = 1e9  # of a number that a log states of itself


@contextmanager
def reading_errors(path: Path, what: str, library: str = "") -> Iterator[None]:
    """Read a log, by a library that is imported within if it is named, and make a record of its values.

    Whatever is raised within, and is not ours, is a fault of the log.

    Raises:
        MissingPackageError: the library is not installed.
        FileError: the log cannot be read.
    """
    try:
        yield
    except QuadsimError:
        raise
    except Exception as error:
        if library and isinstance(error, ModuleNotFoundError):
            raise MissingPackageError(f"a {what}", library, extra="logs") from error
        raise FileError(path, f"is not a readable {what} ({_shortened(error)})") from error


@contextmanager
def fitting_errors(names: str) -> Iterator[None]:
    """Check, fit and predict logs: what their numbers make fail is a fault of theirs.

    Raises:
        InputError: a matrix is singular, or a number is none.
    """
    try:
        yield
    except QuadsimError:
        raise
    except (ArithmeticError, LookupError, ValueError) as error:
        raise InputError(
            f"{names}: no fit is possible ({_shortened(error)}); a column that stands still, or samples far beyond the "
            "others, do that: plot rates, velocity and the rotors' outputs"
        ) from error


def _shortened(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"[:120]


def stated_number(
    path: Path,
    stated: Mapping[str, Any],
    name: str,
    default: float,
    *,
    low: float = -_LARGEST_STATED,
    high: float = _LARGEST_STATED,
    whole: bool = False,
) -> float:
    """Return a header or a parameter of a log; the default where it has none.

    Raises:
        FileError: it is no number, or not within its range.
    """
    value = stated.get(name, default)
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not low <= number <= high or (whole and not number.is_integer()):
        kind = "a whole number" if whole else "a number"
        raise FileError(path, f"states {name} = {value!r:.80}; it must be {kind} from {low:g} to {high:g}")
    return number


def scale_between(path: Path, what: str, low: ArrayLike, high: ArrayLike) -> dict[str, Any]:
    """Return zero and scale of outputs that a log has between two ends, one of each or one per rotor.

    Raises:
        FileError: the ends are not in order.
    """
    zero = np.asarray(low, float)
    full = np.asarray(high, float)
    if not (zero < full).all():
        raise FileError(path, f"states {what} from {zero} to {full}; the longest must be above the shortest")
    return {"zero": zero, "scale": 1.0 / (full - zero)}
