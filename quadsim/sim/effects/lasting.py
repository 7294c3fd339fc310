"""Events that last for a time: which of them are in force, and from when."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Protocol, TypeVar


class Lasting(Protocol):
    """An event in force for a time."""

    @property
    def at(self) -> float:
        """Time at which it starts [s]."""
        ...

    @property
    def duration(self) -> float | None:
        """How long it lasts [s]; None: to the end of the flight."""
        ...


AnyLasting = TypeVar("AnyLasting", bound=Lasting)


def in_force(events: Sequence[AnyLasting]) -> Iterator[tuple[float, list[AnyLasting]]]:
    """Yield the instants [s] at which events start or end, with the events in force from then on, in their order."""
    turns: dict[float, tuple[set[int], set[int]]] = {}
    for i, event in enumerate(events):
        turns.setdefault(event.at, (set(), set()))[0].add(i)
        if event.duration is not None:
            turns.setdefault(event.at + event.duration, (set(), set()))[1].add(i)
    lasting: set[int] = set()
    for time in sorted(turns):
        begun, ended = turns[time]
        lasting = (lasting | begun) - ended
        yield time, [events[i] for i in sorted(lasting)]
