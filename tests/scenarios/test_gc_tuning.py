"""Passes of Python's cycle collector: none over what was there before a flight, while it flies."""

from __future__ import annotations

import gc
import subprocess
import sys
import weakref
from collections.abc import Iterator
from typing import Any, NamedTuple

import pytest

from quadsim.controller import Command, Moment
from quadsim.state import Array
from scenarios import gc_tuning
from scenarios.build import build_controller
from scenarios.gc_tuning import _PROCESS, COLLECT_EVERY, frozen
from scenarios.loading import load_scenario
from scenarios.run import fly_scenario

HOARD = 300_000
"""Objects made before the flight; more than all that is loaded."""
DEFAULTS = (700, 10, 10)
"""Thresholds that Python starts with."""


class Pass(NamedTuple):
    """One pass of the collector: the generation that was due, and how many objects it looks through."""

    generation: int
    objects: int


@pytest.fixture
def passes() -> Iterator[list[Pass]]:
    """The collector's passes, as they happen, with the thresholds that Python starts with."""
    seen: list[Pass] = []

    def note(phase: str, info: dict[str, Any]) -> None:
        if phase == "start":
            oldest = info["generation"]
            seen.append(Pass(oldest, sum(len(gc.get_objects(generation=i)) for i in range(oldest + 1))))

    thresholds = gc.get_threshold()
    gc.set_threshold(*DEFAULTS)
    gc.callbacks.append(note)
    yield seen
    gc.callbacks.remove(note)
    gc.set_threshold(*thresholds)


@pytest.fixture
def thawed(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Nothing was taken for lasting, as in a process that starts; the tests' own process has, see `conftest`."""
    monkeypatch.setattr(_PROCESS, "lasting", False)
    gc.unfreeze()
    yield
    gc.freeze()


class _Noting:
    """A controller that notes what the collector looked through until its last step."""

    def __init__(self, controller: Any, passes: list[Pass]) -> None:
        self._controller, self._passes = controller, passes
        self.name, self.solver, self.horizon = controller.name, controller.solver, controller.horizon
        self.made: list[list[None]] = []
        self.in_flight: list[Pass] = []

    def reset(self, speeds: Array) -> None:
        self._controller.reset(speeds)

    def step(self, now: Moment, state: Array, reference: Array) -> Command:
        gc.enable()
        command: Command = self._controller.step(now, state, reference)
        self.made += [[] for _ in range(100)]  # so that there are young ones to look through
        self.in_flight = self._passes.copy()
        return command


@pytest.mark.usefixtures("thawed")
def test_a_flight_sees_no_pass_over_what_was_there_before(passes: list[Pass], monkeypatch: pytest.MonkeyPatch) -> None:
    flown: list[_Noting] = []
    hoard: list[list[int]] = []

    def build_noting(*arguments: Any) -> _Noting:
        flown.append(_Noting(build_controller(*arguments), passes))
        gc.disable()  # until the flight begins, or they would be looked through before
        hoard.extend([number] for number in range(HOARD))
        passes.clear()
        return flown[-1]

    monkeypatch.setattr("scenarios.run.build_controller", build_noting)
    fly_scenario(load_scenario("paper-unconstrained", ["duration=2.0"]))
    assert len(hoard) == HOARD
    in_flight = flown[0].in_flight
    assert len(in_flight) > 3, "the collector has not run at all"
    assert all(each.generation < 2 and each.objects < HOARD // 10 for each in in_flight), in_flight
    assert gc.get_freeze_count() == 0


class _Knot:
    def __init__(self) -> None:
        self.itself = self


@pytest.mark.usefixtures("thawed")
def test_what_flights_leave_in_cycles_is_collected_between_them() -> None:
    gc.disable()  # nobody else does
    try:
        left = weakref.ref(_Knot())
        for _ in range(COLLECT_EVERY):
            with frozen():
                gc.collect()
    finally:
        gc.enable()
    assert left() is None


def test_what_is_frozen_for_good_stays_so() -> None:
    """In a process that lasts, a flight's own first freeze comes on top, and nothing is thawed."""
    script = """
import gc
from scenarios.gc_tuning import freeze_for_good, frozen
freeze_for_good()
before = gc.get_freeze_count()
loaded = [[] for _ in range(1000)]
with frozen():
    first = gc.get_freeze_count()
flown = [[] for _ in range(1000)]
with frozen():
    second = gc.get_freeze_count()
assert before and first >= before + 1000 and second <= first, (before, first, second)
"""
    subprocess.run([sys.executable, "-c", script], check=True)


def test_flights_are_counted_in_no_module() -> None:
    """Where campaigns look for what a controller changed; see `scenarios.campaign.engine.worker`."""
    before = dict(vars(gc_tuning))
    with frozen():
        pass
    assert all(vars(gc_tuning)[name] is value for name, value in before.items())
