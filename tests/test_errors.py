"""Errors: one root, an exit status each, the values stored, a message a person can act on."""

from __future__ import annotations

import inspect
import pickle

import pytest

from quadsim import errors
from quadsim.errors import (
    CommandError,
    DivergenceError,
    ExportError,
    FileError,
    FlightError,
    ForceError,
    InputError,
    InterruptedFlightError,
    LostError,
    MissingPackageError,
    MissingProgramError,
    OutputError,
    ParameterError,
    PlanExhaustedError,
    QuadsimError,
    RaisedError,
    RenderingUnavailableError,
    UnknownNameError,
    ViewerUnavailableError,
)

SAMPLES: list[QuadsimError] = [
    QuadsimError("a"),
    InputError("a"),
    ParameterError("vehicle", "mass", -1.0, "positive"),
    UnknownNameError("solver", "piqp-dens", ["piqp-dense"], hint="see quadsim list"),
    FileError("a/b.toml", "no such file"),
    MissingPackageError("solver 'daqp'", "daqp", extra="daqp"),
    MissingProgramError("to compile", "make", packages="make gcc"),
    ExportError("its matrices change"),
    OutputError("a/b.toml", "the disk is full"),
    RenderingUnavailableError({"egl": "no libEGL"}),
    ViewerUnavailableError("a"),
    FlightError("lost", time=1.0),
    DivergenceError("lost", time=1.0),
    LostError("speed", "the speed is", "m/s", value=51.0, limit=50.0, time=1.0),
    CommandError("not finite", time=1.0),
    ForceError("not finite", time=1.0),
    PlanExhaustedError("no plan", time=1.0),
    InterruptedFlightError(time=1.0),
    RaisedError("the controller", ZeroDivisionError("of its own"), time=1.0),
]


@pytest.mark.parametrize("error", SAMPLES, ids=lambda error: type(error).__name__)
def test_every_error_comes_whole_from_another_process_with_its_exit_status(error: QuadsimError) -> None:
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is type(error)
    assert (str(again), again.args, vars(again)) == (str(error), error.args, vars(error))
    assert str(again)
    assert error.exit_status == (1 if isinstance(error, FlightError) else 2)


def test_no_error_is_forgotten_here() -> None:
    kinds = {kind for _, kind in inspect.getmembers(errors, inspect.isclass) if kind.__module__ == errors.__name__}
    assert {type(error) for error in SAMPLES} == kinds


def test_an_unknown_name_is_answered_with_the_nearest_if_there_is_one_and_all_there_are() -> None:
    error = UnknownNameError("solver", "piqp-dens", ["piqp-multistage", "piqp-dense"], hint="see quadsim list")
    assert str(error) == (
        "no solver named 'piqp-dens'; did you mean 'piqp-dense'? (there are: piqp-dense, piqp-multistage); "
        "see quadsim list"
    )
    assert str(UnknownNameError("solver", "osqp", ["dense"])) == "no solver named 'osqp' (there are: dense)"
    names = [f"signal_{i}" for i in range(40)]
    assert str(UnknownNameError("signal", "q", names)).endswith(", ...)")
    assert str(UnknownNameError("signal", "q", names, whole=True)).endswith(", signal_9)")
