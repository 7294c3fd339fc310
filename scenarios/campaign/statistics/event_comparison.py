"""What happened more often to one of two campaigns than to the other, flight by flight."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import pyarrow as pa

from scenarios.campaign.results.columns import constraint_names, flags
from scenarios.campaign.results.events import EVENT_NAMES, Flags, parse_event
from scenarios.campaign.results.table import SATISFIED
from scenarios.campaign.statistics.inference import ALPHA, holm, mcnemar, paired_shares
from scenarios.campaign.statistics.wording import p_value


@dataclass(frozen=True, kw_only=True)
class EventComparison:
    """How often an event happened to one, to the other, and to both."""

    event: str  # its name
    both: int  # pairs in which it happened to both flights
    only_a: int  # to the first campaign's alone
    only_b: int  # to the second campaign's alone
    neither: int  # to none of them
    p: float  # two-sided p-value of McNemar's exact test
    # that, corrected by Holm's method for all compared events that happened to one flight of a pair alone
    p_holm: float
    difference: float  # share of b - share of a
    lower: float  # lower end of Tango's interval of that
    upper: float  # its upper end

    @property
    def counts(self) -> tuple[int, int]:
        """Flights of the first and of the second campaign in which it happened."""
        return self.both + self.only_a, self.both + self.only_b

    @property
    def cells(self) -> tuple[int, int, int]:
        """Pairs in which it happened to both, to the first alone, and to the second alone."""
        return self.both, self.only_a, self.only_b

    @property
    def pairs(self) -> int:
        """All pairs."""
        return self.both + self.only_a + self.only_b + self.neither


def events_of(a: pa.Table, b: pa.Table) -> dict[str, tuple[Flags, Flags]]:
    """Everything that may have happened to a flight, (K,) of each campaign: failure first, constraints last."""
    named = {name: parse_event(name) for name in EVENT_NAMES}
    found = {name: (event.column(a), event.column(b)) for name, event in named.items()}
    for name in constraint_names(a):
        column = SATISFIED + name
        found[f"{name} not held"] = (~flags(a, column, absent=False), ~flags(b, column, absent=False))
    return found


def compare_events(events: Mapping[str, tuple[Flags, Flags]]) -> tuple[EventComparison, ...]:
    """Every event with its test, corrected for all of them but those that no flight of a pair had alone.

    These have a p-value of 1 whatever the others are, so that there is nothing to correct for (Tarone, 1990).  Events
    are given by name, as (K,) whether each happened to the flights of the first and of the second campaign.
    """
    alone = {event: (int((a & ~b).sum()), int((b & ~a).sum())) for event, (a, b) in events.items()}
    tested = [event for event, counts in alone.items() if any(counts)]
    corrected = dict(zip(tested, holm([mcnemar(*alone[event]) for event in tested]), strict=True))
    found = []
    for event, (a, b) in events.items():
        only_a, only_b = alone[event]
        both = int((a & b).sum())
        lower, upper = paired_shares(only_a, only_b, a.size)
        found.append(
            EventComparison(
                event=event,
                both=both,
                only_a=only_a,
                only_b=only_b,
                neither=a.size - both - only_a - only_b,
                p=mcnemar(only_a, only_b),
                p_holm=corrected.get(event, 1.0),
                difference=(only_b - only_a) / a.size,
                lower=lower,
                upper=upper,
            )
        )
    return tuple(found)


def other_differences(events: Sequence[EventComparison], names: tuple[str, str]) -> str:
    """What else than the first event happened more often to one of two campaigns, beyond chance or not, as a sentence.

    A second event of the same numbers as the first, as violation is where it alone counts as failure, is not reported.
    """
    first, *others = events
    others = [event for event in others if event.only_a != event.only_b]
    others = [event for event in others if event.event != "violation" or event.cells != first.cells]
    sure = [_told(event) for event in others if event.p_holm < ALPHA]
    rest = [_told(event) for event in others if event.p_holm >= ALPHA]
    parts = []
    if sure:
        parts.append(f"beyond chance in {', '.join(sure)}")
    if rest:
        parts.append(f"in count, but not beyond chance, in {', '.join(rest)}")
    if not parts:
        return ""
    tests = sum(1 for event in events if event.only_a + event.only_b)
    return (
        f"Flights with {names[1]} and with {names[0]} {'also ' if first.p < ALPHA else ''}differ "
        f"{'; and '.join(parts)} (McNemar's exact test of each event, after Holm's correction for {tests})."
    )


def _told(event: EventComparison) -> str:
    """An event with its counts, the second campaign's first, as in the sentence around it."""
    count_a, count_b = event.counts
    return f"{event.event} ({count_b} and {count_a}, {p_value(event.p_holm)})"
