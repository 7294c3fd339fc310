"""A requirement on a probability, and whether a campaign's flights support it: the gate of a CI."""

from __future__ import annotations

import contextlib
import math
import re
from dataclasses import asdict, dataclass
from decimal import Decimal
from typing import Any, Final

import pyarrow as pa

from quadsim.errors import InputError, ParameterError
from scenarios.campaign.results.events import OPERATIONS, Event, parse_event
from scenarios.campaign.results.table import is_counted
from scenarios.campaign.statistics.inference import lower_bounds, upper_bounds
from scenarios.campaign.statistics.wording import count_of, percent

EXAMPLE: Final = "P(violation) < 0.01 @ 95%"
_SHARES: Final = (Decimal("1e-9"), 1 - Decimal("1e-9"))
_CONFIDENCES: Final = (Decimal("0.5"), Decimal("0.999999"))
_MOST_REPORTED: Final = 10**9  # flights beyond which a message states only that it takes more
_FORM: Final = re.compile(
    r"P\s*\((?P<event>[^()]*)\)\s*(?P<operation><=|>=|<|>)\s*(?P<share>[^<>=@]+?)\s*@\s*(?P<confidence>[^@%]+?)\s*%",
    re.IGNORECASE,
)


@dataclass(frozen=True, kw_only=True)
class Requirement:
    """The probability of an event on one side of a share, with this confidence."""

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
        """Whether a one-sided bound on the probability is on the required side."""
        return bool(OPERATIONS[self.operation](bound, self.share))


@dataclass(frozen=True, kw_only=True)
class Judgement:
    """Whether the flights support a requirement."""

    requirement: Requirement
    count: int  # flights in which the event happened
    flights: int
    bound: float  # one-sided, at the requirement's confidence: upper where the probability is to be small, else lower
    holds: bool
    least_flights: int  # that can support it, all of them in its favour

    @property
    def sentence(self) -> str:
        """The judgement with its numbers."""
        required = self.requirement
        share = f" ({percent(self.count / self.flights)})" if self.flights else ""
        phrase = (
            f"{required.text} {'holds' if self.holds else 'does not hold'}: {required.event.text} in {self.count} of "
            f"{count_of(self.flights, 'flight')}{share}, so with {100.0 * required.confidence:g} % confidence at "
            f"{'most' if required.at_most else 'least'} {percent(self.bound, digits=3)}."
        )
        if self.flights >= self.least_flights:
            return phrase
        least = f"at least {count_of(self.least_flights, 'flight')}"
        if self.least_flights > _MOST_REPORTED:
            least = f"more than {_MOST_REPORTED:,} flights"
        return f"{phrase} It takes {least}, {'none' if required.at_most else 'all'} of them with that event."

    def to_json(self) -> dict[str, Any]:
        """Plain data for `summary.json`."""
        required = asdict(self.requirement) | {"event": self.requirement.event.text}
        return asdict(self) | {"requirement": required, "sentence": self.sentence}


def parse_requirement(text: str) -> Requirement:
    """A requirement `P(EVENT) OP SHARE @ CONFIDENCE%`, with an event as `events.parse_event` takes it.

    The share is from 1e-9 to 1 - 1e-9, as such or in percent, the confidence from 50 to 99.9999 percent.

    Raises:
        InputError: it is not of that form.
        UnknownNameError: there is no such event.
        ParameterError: a number is outside what is allowed.
    """
    text = " ".join(text.split())
    owner, found = f"requirement {text!r}", _FORM.fullmatch(text)
    if found is None:
        raise InputError(
            f"{owner} must read P(EVENT) OP SHARE @ CONFIDENCE%, with one of < <= > >=, such as {EXAMPLE!r}"
        )
    return Requirement(
        text=text,
        event=parse_event(found["event"].strip()),
        operation=found["operation"],
        share=_number(owner, "share", found["share"], *_SHARES),
        confidence=_number(owner, "confidence", found["confidence"] + "%", *_CONFIDENCES),
    )


def judge(table: pa.Table, requirement: Requirement) -> Judgement:
    """Hold a campaign's flights, `flights.parquet`, against a requirement.

    It holds when the one-sided Clopper-Pearson bound at its confidence is on the required side; so it takes
    flights enough, and no flights support nothing.  Incomplete flights do not count (`results.table.is_counted`).

    Raises:
        UnknownNameError: the table has no column that the event names.
        InputError: the event compares text with a number.
    """
    happened = requirement.event.column(table)[is_counted(table, requirement.event)]
    count, flights = int(happened.sum()), happened.size
    bound = _bound(requirement, count, flights)
    holds, least = flights > 0 and requirement.supported_by(bound), least_flights(requirement)
    return Judgement(
        requirement=requirement, count=count, flights=flights, bound=bound, holds=holds, least_flights=least
    )


def least_flights(requirement: Requirement) -> int:
    """The smallest number of flights that can support a requirement, all of them in its favour.

    With n such flights the bound is (1 - confidence)^(1/n) from the far end, which requires
    n = ln(1 - confidence) / ln(1 - share); at a tie, the bound itself as it is computed decides.
    """
    per_flight = math.log1p(-requirement.share) if requirement.at_most else math.log(requirement.share)
    n = max(1, math.ceil(math.log1p(-requirement.confidence) / per_flight))
    near = range(max(1, n - 1), n + 2)
    best = ((k, _bound(requirement, 0 if requirement.at_most else k, k)) for k in near)
    return next((k for k, bound in best if requirement.supported_by(bound)), n)


def _bound(requirement: Requirement, count: int, flights: int) -> float:
    """The one-sided bound on the probability."""
    bounds = upper_bounds if requirement.at_most else lower_bounds
    return float(bounds(count, flights, requirement.confidence))


def _number(owner: str, name: str, given: str, low: Decimal, high: Decimal) -> float:
    """A share of one, given as such or in percent."""
    in_percent = given.endswith("%")
    with contextlib.suppress(ArithmeticError):
        value = Decimal(given.removesuffix("%").strip()) / (100 if in_percent else 1)
        if low <= value <= high:
            return float(value)
    rule = f"a number from {low} to {high}".lower()
    if in_percent:
        rule = f"from {(100 * low).normalize():f}% to {(100 * high).normalize():f}%"
    raise ParameterError(owner, name, given, rule)
