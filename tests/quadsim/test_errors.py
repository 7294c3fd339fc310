"""Errors: one root, an exit status each, the values stored, a message a person can act on."""

from __future__ import annotations

import inspect
import pickle

import pytest

from quadsim import errors
from quadsim.errors import (
    CommandError,
    CompilerError,
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

EVERY = [kind for _, kind in inspect.getmembers(errors, inspect.isclass) if kind.__module__ == errors.__name__]
FLIGHT = {kind for kind in EVERY if issubclass(kind, FlightError)}


SAMPLES: list[QuadsimError] = [
    QuadsimError("a"),
    InputError("a"),
    ParameterError("vehicle", "mass", -1.0, "positive"),
    UnknownNameError("solver", "piqp-dens", ["piqp-dense"], hint="see quadsim list"),
    FileError("a/b.toml", "no such file"),
    MissingPackageError("solver 'daqp'", "daqp", extra="daqp"),
    MissingProgramError("to compile", "make", packages="make gcc"),
    CompilerError("a"),
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
def test_every_error_comes_whole_from_another_process(error: QuadsimError) -> None:
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is type(error)
    assert (str(again), again.args, vars(again)) == (str(error), error.args, vars(error))
    assert str(again)


def test_no_error_is_forgotten_here() -> None:
    assert {type(error) for error in SAMPLES} == set(EVERY)


@pytest.mark.parametrize("kind", EVERY)
def test_every_error_has_the_root_and_the_exit_status_of_its_family(kind: type[QuadsimError]) -> None:
    assert issubclass(kind, QuadsimError)
    assert kind.exit_status == (1 if kind in FLIGHT else 2)
    assert issubclass(kind, FlightError) == (kind in FLIGHT)


def test_a_parameter_error_stores_its_values() -> None:
    error = ParameterError("vehicle", "mass", -1.0, "positive")
    assert str(error) == "vehicle.mass must be positive; got -1.0"
    assert (error.owner, error.name, error.value, error.rule) == ("vehicle", "mass", -1.0, "positive")


def test_an_unknown_name_is_answered_with_the_nearest_and_all_there_are() -> None:
    error = UnknownNameError("solver", "piqp-dens", ["piqp-multistage", "piqp-dense"], hint="see quadsim list")
    assert str(error) == (
        "no solver named 'piqp-dens'; did you mean 'piqp-dense'? (there are: piqp-dense, piqp-multistage); "
        "see quadsim list"
    )
    assert (error.kind, error.name, error.allowed) == ("solver", "piqp-dens", ("piqp-dense", "piqp-multistage"))


def test_nothing_is_guessed_where_nothing_is_near() -> None:
    assert str(UnknownNameError("solver", "osqp", ["dense"])) == "no solver named 'osqp' (there are: dense)"
