"""Count the kinds that a reader of one flight meets; run it from the repository: `python tests/count_types.py`.

Both counts are of `paper-constrained`.  A data type is a dataclass or a named tuple of ours that is made between the
plant's state at a control period's start and the log of that period.  A class is one of ours that is made, or of which
a method runs, from the scenario's file to the summary of the flight.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import is_dataclass
from types import FrameType

import quadsim
from quadsim.rollout.rollout import Rollout
from quadsim.sim.physics import one_period

SCENARIO = "paper-constrained"
SETTLED, WATCHED = 150, 20
"""Periods flown before any is watched, so that what is made once has been made; and then, so that one of them checks
its KKT residuals."""
SECONDS = 10.0  # of the whole flight; by then constraints have been active
PACKAGES = ("quadsim.",)


def method_of(frame: FrameType) -> tuple[type, str] | None:
    """Return the class of ours and the name of the method, written or generated, that a frame runs."""
    code = frame.f_code
    if not code.co_argcount:
        return None
    first, name = code.co_varnames[0], code.co_name
    if first == "_cls" and name == "<lambda>":  # how a named tuple is made
        name = "__new__"
    owner = frame.f_locals.get(first)
    kind = owner if isinstance(owner, type) else type(owner)
    ours = (one for one in kind.__mro__ if f"{one.__module__}.".startswith(PACKAGES))
    return (kind, name) if any(name in vars(one) for one in ours) else None


@contextmanager
def watching(kinds: set[type], *, made: bool) -> Iterator[None]:
    """Add the classes that are met inside; only those that are `made`, if so."""

    def watch(frame: FrameType, event: str, _: object) -> None:  # of calls alone, as it returns no function for lines
        if (method := method_of(frame)) is not None:
            kind, name = method
            if not made or name in ("__init__", "__new__"):
                kinds.add(kind)

    sys.settrace(watch)
    try:
        yield
    finally:
        sys.settrace(None)


def types_of_a_period() -> set[type]:
    """Return the data types that a control period passes through."""
    kinds: set[type] = set()
    scenario = quadsim.load(SCENARIO)
    with Rollout(scenario) as rollout:
        while rollout.k < SETTLED:
            rollout.step()
        with watching(kinds, made=True):
            for _ in range(WATCHED):
                one_period(rollout.step(), scenario.plant.timestep)
    return {kind for kind in kinds if is_dataclass(kind) or hasattr(kind, "_fields")}


def classes_of_a_flight() -> set[type]:
    """Return the classes met in a flight."""
    kinds: set[type] = set()
    with watching(kinds, made=False):
        _ = quadsim.fly(quadsim.load(SCENARIO).replace({"duration": SECONDS}), progress=False).summary
    return kinds


if __name__ == "__main__":
    for what, kinds in (
        ("data types of a period", types_of_a_period()),
        ("classes of a flight", classes_of_a_flight()),
    ):
        print(len(kinds), what)
        print(*sorted(f"    {kind.__module__}.{kind.__qualname__}" for kind in kinds), sep="\n")
