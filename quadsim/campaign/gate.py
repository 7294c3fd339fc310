"""A requirement on a probability, and whether a campaign's flights support it: the gate of a CI."""

from __future__ import annotations

import math
import re
from dataclasses import asdict, dataclass
from typing import Any, Final

import pyarrow as pa

from quadsim.campaign.events import Event, parse_event
from quadsim.campaign.statistics import lower_bound, upper_bound
from quadsim.campaign.wording import count_of, percent
from quadsim.errors import InputError, ParameterError

EXAMPLE: Final = "P(violation) < 0.01 @ 95%"
_FORM: Final = re.compile(
    r"P\s*\((?P<event>[^()]*)\)\s*(?P<operation><=|>=|<|>)\s*(?P<share>[^<>=@]+?)\s*@\s*(?P<confidence>[^@%]+?)\s*%",
    re.IGNORECASE,
)


@dataclass(frozen=True, kw_only=True)
class Requirement:
    """What is asked: the probability of an event on one side of a share, with this confidence.

    Attributes:
        text: as it was given.
        event: whose probability.
        operation: `<`, `<=`, `>` or `>=`.
        share: the limit on the probability, above 0 and below 1.
        confidence: of the one-sided bound, from 0.5 to below 1.
    """

    text: str
    event: Event
    operation: str
    share: float
    confidence: float

    @property
    def at_most(self) -> bool:
        """Whether the probability is to be small, rather than large."""
        return self.operation.startswith("<")

    def supported_by(self, bound: float) -> bool:
        """Whether a one-sided bound on the probability is on the side that is asked for."""
        strict = len(self.operation) == 1
        inside = bound < self.share if self.at_most else bound > self.share
        return inside or (not strict and bound == self.share)


@dataclass(frozen=True, kw_only=True)
class Judgement:
    """Whether the flights support a requirement.

    Attributes:
        requirement: what was asked.
        count: flights in which the event happened.
        flights: of how many.
        bound: the one-sided Clopper-Pearson bound at the requirement's confidence: upper where the probability is to
            be small, lower where it is to be large.
        holds: whether the bound supports the requirement.
        least_flights: how many flights it takes at the very least, all of them without the event where it is to be
            rare, and all with it where it is to be frequent.
    """

    requirement: Requirement
    count: int
    flights: int
    bound: float
    holds: bool
    least_flights: int

    @property
    def sentence(self) -> str:
        """The judgement with its numbers."""
        asked = self.requirement
        share = f" ({percent(self.count / self.flights)})" if self.flights else ""
        told = (
            f"{asked.text} {'holds' if self.holds else 'does not hold'}: {asked.event.text} in {self.count} of "
            f"{count_of(self.flights, 'flight')}{share}, so with {100.0 * asked.confidence:g} % confidence at "
            f"{'most' if asked.at_most else 'least'} {percent(self.bound, digits=3)}."
        )
        if self.flights >= self.least_flights:
            return told
        return (
            f"{told} It takes at least {count_of(self.least_flights, 'flight')}, "
            f"{'none' if asked.at_most else 'all'} of them with that event."
        )

    def to_json(self) -> dict[str, Any]:
        """Plain data for `summary.json`."""
        asked = asdict(self.requirement) | {"event": self.requirement.event.text}
        return asdict(self) | {"requirement": asked, "sentence": self.sentence}


def parse_requirement(text: str) -> Requirement:
    """A requirement from its text.

    Args:
        text: `P(EVENT) OP SHARE @ CONFIDENCE%`: an event as `quadsim.campaign.events.parse_event` takes it, one of
            `< <= > >=`, a share above 0 and below 1 or in percent, and the confidence in percent.

    Raises:
        InputError: it is not of that form.
        UnknownNameError: there is no such event.
        ParameterError: a number is outside what is allowed.
    """
    text = " ".join(text.split())
    found = _FORM.fullmatch(text)
    if found is None:
        raise InputError(
            f"requirement {text!r} must read P(EVENT) OP SHARE @ CONFIDENCE%, with one of < <= > >=, such as "
            f"{EXAMPLE!r}"
        )
    owner = f"requirement {text!r}"
    share = _number(owner, "share", found["share"], low=0.0, low_included=False)
    confidence = _number(owner, "confidence", found["confidence"] + "%", low=0.5, low_included=True)
    return Requirement(
        text=text,
        event=parse_event(found["event"].strip()),
        operation=found["operation"],
        share=share,
        confidence=confidence,
    )


def judge(table: pa.Table, requirement: Requirement) -> Judgement:
    """Hold a campaign's flights against a requirement.

    It holds when the one-sided Clopper-Pearson bound at its confidence is on the side that is asked for; so it takes
    flights enough, and no flights support nothing.

    Args:
        table: `flights.parquet`.
        requirement: what is asked.

    Raises:
        UnknownNameError: the table has no column that the event names.
        InputError: the event compares text with a number.
    """
    happened = requirement.event.column(table)
    count, flights = int(happened.sum()), happened.size
    bound = (upper_bound if requirement.at_most else lower_bound)(count, flights, requirement.confidence)
    return Judgement(
        requirement=requirement,
        count=count,
        flights=flights,
        bound=bound,
        holds=flights > 0 and requirement.supported_by(bound),
        least_flights=least_flights(requirement),
    )


def least_flights(requirement: Requirement) -> int:
    """The smallest number of flights that can support a requirement, all of them as it wishes.

    With n such flights the bound is (1 - confidence)^(1/n) from the far end: n = ln(1 - confidence) / ln(1 - share).
    """
    missing = 1.0 - requirement.confidence
    kept = 1.0 - requirement.share if requirement.at_most else requirement.share
    n = max(1, math.floor(math.log(missing) / math.log(kept)) - 1)
    while not requirement.supported_by(_best_bound(requirement, n)):
        n += 1
    return n


def _best_bound(requirement: Requirement, n: int) -> float:
    if requirement.at_most:
        return upper_bound(0, n, requirement.confidence)
    return lower_bound(n, n, requirement.confidence)


def _number(owner: str, name: str, given: str, *, low: float, low_included: bool) -> float:
    """A share of one, given as such or in percent."""
    rule = f"{'from' if low_included else 'above'} {100 * low:g}% and below 100%"
    digits, in_percent = given.removesuffix("%").strip(), given.endswith("%")
    try:
        value = float(digits) / (100.0 if in_percent else 1.0)
    except ValueError:
        value = math.nan
    if not (low <= value < 1.0 if low_included else low < value < 1.0):
        raise ParameterError(owner, name, given, rule if in_percent else "a number above 0 and below 1")
    return value
