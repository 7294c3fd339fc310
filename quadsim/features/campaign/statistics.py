"""Statistics of a campaign's flights with their confidence, their wording, and requirements on them.

k of n flights: the share k/n with Clopper-Pearson's interval; ranks: Spearman's rho and Chatterjee's xi, by Holm's
method.  Flights are taken as independent draws.  Draws spread evenly (Latin hypercube, Sobol', Halton) make estimates
vary less than that, so that the intervals are then wider than they need be.  `campaign` and the reports use them.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from decimal import Decimal
from typing import Any, Final

import numpy as np
import pyarrow as pa
import scipy
from numpy.typing import ArrayLike

from quadsim.errors import InputError, ParameterError
from quadsim.features.campaign.events import (
    EVENT_NAMES,
    OPERATIONS,
    VERDICTS,
    CountedEvent,
    FlightFlags,
    parse_event,
)
from quadsim.features.campaign.rows import (
    DRAW,
    MARGIN,
    CampaignSummary,
    constraint_names,
    draw_names,
    flags,
    is_counted,
    is_number,
    metric_names,
    not_held,
    numbers,
    reached,
    texts,
    unaudited,
    unit_of,
    verdicts,
)
from quadsim.flight.audit import UNAUDITED_ADVICE, Limit
from quadsim.report.table import ABSENT
from quadsim.state import Array, Indices
from quadsim.ties import TIE_SHARE, first_smallest, in_order


def percent(share: float | None, digits: int = 2) -> str:
    """A share in percent, e.g. `3.7 %`: enough digits that its distance to 0 or 100 % shows, and at least tenths."""
    if share is None:
        return ABSENT
    return f"{_percent(share, digits)} %"


def interval(lower: float, upper: float) -> str:
    """An interval of a share, e.g. `2.6 to 5.1 %`."""
    return f"{_percent(lower)} to {_percent(upper)} %"


def label(name: str, unit: str) -> str:
    """A name with its unit, where it has one."""
    if unit == "-":
        return name
    return f"{name} [{unit}]"


def count_of(count: int, thing: str) -> str:
    """A count with its noun: `1 flight`, `12 flights`."""
    if count == 1:
        return f"1 {thing}"
    return f"{count} {thing}s"


def p_value(p: float) -> str:
    """A p-value, e.g. `p = 0.012`, or `p < 0.001`."""
    if p < 0.001:
        return "p < 0.001"
    return f"p = {p:.2g}"


def _percent(share: float, digits: int = 2) -> str:
    value = 100.0 * share
    distance = min(abs(value), abs(100.0 - value))
    if distance > 1e-9:
        decimals = max(1, digits - 1 - math.floor(math.log10(distance)))
    else:
        decimals = 0
    return f"{value:.{decimals}f}"


CONFIDENCE: Final = 0.95
ALPHA: Final = 0.05  # level of the tests


@dataclass(frozen=True, kw_only=True)
class PairedDifference:
    """The differences b - a of pairs."""

    pairs: int
    mean: float | None = None  # None of no pairs
    lower: float | None = None  # ends of the mean's t interval; None of fewer than two pairs
    upper: float | None = None


def upper_bounds(counts: ArrayLike, trials: ArrayLike, confidence: float = CONFIDENCE) -> Array:
    """One-sided upper bounds on proportions, one or (K,): the largest p that gives so few with chance 1 - confidence.

    In closed form, as scipy's `proportion_ci` searches to 1e-12 alone, which is too coarse for shares near 1e-9.
    Source: Clopper and Pearson, Biometrika 26 (1934); 1 where all happened, and of no trials.
    """
    counts = np.asarray(counts, float)
    trials = np.asarray(trials, float)
    not_all = counts < trials
    failures = np.where(not_all, trials - counts, 1.0)
    bounds = scipy.special.betaincinv(counts + 1.0, failures, confidence)
    return np.where(not_all, bounds, 1.0)


def lower_bounds(counts: ArrayLike, trials: ArrayLike, confidence: float = CONFIDENCE) -> Array:
    """One-sided lower bounds on proportions, one or (K,); 0 where none happened."""
    complements = np.asarray(trials, float) - np.asarray(counts, float)
    return 1.0 - upper_bounds(complements, trials, confidence)


def proportion(count: int, flights: int) -> dict[str, Any]:
    """A share of flights, None of none, with its Clopper-Pearson interval and one-sided bounds: plain data for JSON."""
    one_sided = 0.5 * (1.0 + CONFIDENCE)  # the confidence of either end of a two-sided interval
    return {
        "count": count,
        "flights": flights,
        "share": count / flights if flights else None,
        "lower": float(lower_bounds(count, flights, one_sided)),
        "upper": float(upper_bounds(count, flights, one_sided)),
        "lower_one_sided": float(lower_bounds(count, flights)),
        "upper_one_sided": float(upper_bounds(count, flights)),
    }


def share_of(happened: np.ndarray[Any, np.dtype[np.bool_]]) -> dict[str, Any]:
    """The `proportion` of the flights (K,) to which something happened."""
    return proportion(int(happened.sum()), happened.size)


def holm(p_values: Sequence[float]) -> list[float]:
    """P-values of several tests, corrected so that the chance of any false find stays at the level.

    Source: Holm, Scandinavian Journal of Statistics 6 (1979).
    """
    order = np.argsort(p_values, kind="stable")
    factors = len(p_values) - np.arange(len(p_values))
    ascending = np.asarray(p_values, float)[order]
    corrected = np.minimum(1.0, np.maximum.accumulate(factors * ascending))
    places = np.argsort(order, kind="stable")
    in_place: list[float] = corrected[places].tolist()
    return in_place


def mcnemar(only_a: int, only_b: int) -> float:
    """Two-sided p-value of McNemar's exact test: a discordant pair is as likely to be of the first as of the second."""
    discordant = only_a + only_b
    if discordant:
        return float(scipy.stats.binomtest(only_a, discordant).pvalue)
    return 1.0


def paired_difference(a: Array, b: Array) -> PairedDifference:
    """Mean of b - a, (K,) finite each, with Student's t interval."""
    differences = np.asarray(b, float) - np.asarray(a, float)
    n = differences.size
    if not n:
        return PairedDifference(pairs=0)
    mean = float(differences.mean())
    if n == 1:
        return PairedDifference(pairs=1, mean=mean)
    quantile = float(scipy.stats.t.ppf(0.5 * (1.0 + CONFIDENCE), n - 1))
    half = quantile * float(differences.std(ddof=1)) / math.sqrt(n)
    return PairedDifference(pairs=n, mean=mean, lower=mean - half, upper=mean + half)


_FEWEST_PAIRS: Final = 10
"""Pairs from which Student's t describes a rank correlation well: of five in order, it claims p = 0."""
_PERMUTED_UP_TO: Final = 40
"""Pairs up to which xi's p-value is from permutations; beyond, its asymptotic distribution is as good."""
_PERMUTATIONS: Final = 9999


@dataclass(frozen=True, kw_only=True)
class Dependence:
    """Dependence of an outcome on a number."""

    rho: float  # Spearman's rank correlation, from -1 to 1
    p: float  # its two-sided p-value
    xi: float  # Chatterjee's xi: about 0 where there is no dependence, 1 where the outcome is a function of the number
    p_xi: float  # its one-sided p-value; of an event, that of the Kolmogorov-Smirnov test
    flights: int  # pairs


def dependence(x: Array, y: Array, rng: np.random.Generator) -> Dependence | None:
    """How y depends on x, (K,) each, by two measures; ties have their mean rank.

    Pairs with a NaN do not count, infinities have their rank.  xi puts equal values of x in an order at random, as its
    author advises; its p-value is from permutations of up to 40 pairs, and from its asymptotic distribution beyond.
    The latter is wrong for rare events (300 flights, 2 %: p < 0.005 in 4 of 100 by chance): for a y with two values,
    the p-value is that of the Kolmogorov-Smirnov test of x with the one and the other.  None of fewer than ten pairs,
    or where one side is always the same.
    Source: Chatterjee, Journal of the American Statistical Association 116 (2021).
    """
    known = ~(np.isnan(x) | np.isnan(y))
    x = scipy.stats.rankdata(x[known])
    y = scipy.stats.rankdata(y[known])
    if x.size < _FEWEST_PAIRS or np.ptp(x) == 0.0 or np.ptp(y) == 0.0:
        return None
    rho = scipy.stats.spearmanr(x, y)
    by_x = np.lexsort((rng.random(x.size), x))  # equal values of x in an order at random
    is_event = np.unique(y).size == 2
    null_distribution: Any = "asymptotic"
    if y.size <= _PERMUTED_UP_TO and not is_event:
        null_distribution = scipy.stats.PermutationMethod(n_resamples=_PERMUTATIONS, rng=rng)
    xi = scipy.stats.chatterjeexi(np.arange(y.size), y[by_x], method=null_distribution)
    if is_event:
        happened = y > y.min()
        p_xi = scipy.stats.ks_2samp(x[happened], x[~happened]).pvalue
    else:
        p_xi = xi.pvalue
    return Dependence(
        rho=float(rho.statistic), p=float(rho.pvalue), xi=float(xi.statistic), p_xi=float(p_xi), flights=y.size
    )


FAILURE: Final = parse_event("failure")
WORST_FLIGHTS: Final = 10
_PERCENTILES: Final = {"min": 0, "p5": 5, "p50": 50, "p95": 95, "p99": 99, "max": 100}
_FLIGHTS_OF_FIFTHS: Final = 50
_FLIGHTS_OF_THIRDS: Final = 12
"""Numbers of flights from which a varied parameter is split into five, or three, groups of about equal size."""
_SHOWN_OF_FLIGHT: Final = ("flight", "verdict", "failed", "worst_margin", "worst_constraint", "duration", "reason")
"""Columns that the summary has of the worst flights."""


def estimate(table: pa.Table, limits: Sequence[Limit] = ()) -> dict[str, Any]:
    """Return the part of a campaign's summary about its flights, as plain data for JSON.

    `limits` are those of the audit: of flights whose worst margins of one are tied (`Limit.tie`), the first counts as
    the worst; of limits that are absent, only equal margins are tied.

    Keys: `flights`; `confidence` of every interval; `verdicts`, flights of each; `events` and `constraints`, by name,
    as `proportion`, a constraint's being that it did not hold, among the flights that reached it or were lost before;
    `metrics`, over the flights that have each; `parameters`, how the outcome depends on each varied parameter;
    `worst`, the ten worst flights.

    Incomplete and unaudited flights are neither failures nor successes (`rows.is_counted`): the shares of failure and
    violation, and `parameters`, leave them out.
    """
    ties = {limit.name: limit.tie for limit in limits}
    events = {}
    for name in EVENT_NAMES:
        event = parse_event(name)
        events[event.text] = share_of(event.column(table)[is_counted(table, event)])
    constraints = {}
    for name in constraint_names(table):
        constraints[name] = _constraint(table, name, ties.get(name, 0.0))
    worst_rows = ranking(table)[:WORST_FLIGHTS].tolist()
    return {
        "flights": table.num_rows,
        "confidence": CONFIDENCE,
        "verdicts": {verdict: int(flown.sum()) for verdict, flown in verdicts(table).items()},
        "events": events,
        "metrics": {name: _metric(table, name) for name in metric_names(table)},
        "constraints": constraints,
        "parameters": parameters(table.filter(is_counted(table, FAILURE))),
        "worst": [_flight(table, row) for row in worst_rows],
    }


def worst_flight(table: pa.Table) -> int:
    """The number of the worst flight; see `ranking`.

    Raises:
        ParameterError: there is no flight.
    """
    if not table.num_rows:
        raise ParameterError("campaign", "flights", 0, "at least one, to find the worst")
    return int(table["flight"][int(ranking(table)[0])].as_py())


def ranking(table: pa.Table) -> Indices:
    """(K,) rows of the table, from the worst flight on.

    By verdict (`VerdictMeaning.badness`); of one verdict, failed ones come first, then the smaller worst margin.
    Flights without a margin come after those with one, by their RMS error in position, the largest first.  Margins
    that are tied, and errors that differ by a share of `TIE_SHARE` at most, are in the order of the flights' numbers.
    """
    badness = [VERDICTS[name].badness for name in texts(table, "verdict")]
    failed = flags(table, "failed", absent=True)
    margin = numbers(table, "worst_margin")
    errors = np.stack([np.nan_to_num(numbers(table, f"rmse.{axis}")) for axis in "xyz"])
    distance = np.linalg.norm(errors, axis=0)
    no_margin = np.isnan(margin)
    score = np.where(no_margin, -distance, margin)  # the smaller, the worse
    groups: dict[tuple[int, bool, bool], list[int]] = {}  # rows that the score alone ranks, in order of their numbers
    for row in np.argsort(numbers(table, "flight"), kind="stable").tolist():
        group = (-badness[row], not failed[row], bool(no_margin[row]))
        groups.setdefault(group, []).append(row)
    ranked: list[int] = []
    for (_, _, by_distance), members in sorted(groups.items()):
        rows = np.array(members)
        window = TIE_SHARE
        if by_distance:
            window *= float(distance[rows].max())
        ranked.extend(rows[in_order(score[rows], window)].tolist())
    return np.array(ranked, int)


def _metric(table: pa.Table, name: str) -> dict[str, Any]:
    """Return the distribution of a metric over the flights that have it."""
    values = numbers(table, name)
    values = values[np.isfinite(values)]
    summary: dict[str, Any] = {"unit": unit_of(table, name), "flights": int(values.size)}
    summary |= dict.fromkeys(("mean", "sd", *_PERCENTILES))
    if values.size:
        percentiles = np.percentile(values, [*_PERCENTILES.values()]).tolist()
        summary["mean"] = float(values.mean())
        summary |= dict(zip(_PERCENTILES, percentiles, strict=True))
    if values.size > 1:
        summary["sd"] = float(values.std(ddof=1))
    return summary


def _constraint(table: pa.Table, name: str, tie: float) -> dict[str, Any]:
    """Return how often a constraint did not hold, and its worst margin with the flight that has it."""
    margin = numbers(table, MARGIN + name)
    summary: dict[str, Any] = {
        "unit": unit_of(table, MARGIN + name),
        "not_satisfied": share_of(not_held(table, name)[reached(table, name)]),
        "worst_margin": None,
        "worst_flight": None,
    }
    rows = np.flatnonzero(np.isfinite(margin))
    if rows.size:
        worst = int(rows[first_smallest(margin[rows], tie)])
        summary["worst_margin"] = float(margin[rows].min())
        summary["worst_flight"] = table["flight"][worst].as_py()
    return summary


def _flight(table: pa.Table, row: int) -> dict[str, Any]:
    """Return what the summary has of one of the worst flights."""
    (values,) = table.slice(row, 1).to_pylist()
    summary: dict[str, Any] = {name: values[name] for name in _SHOWN_OF_FLIGHT}
    summary["margin"] = values.get(f"{MARGIN}{values['worst_constraint']}")
    summary["draws"] = {name: values[DRAW + name] for name in draw_names(table)}
    return summary


def parameters(table: pa.Table) -> dict[str, Any]:
    """A campaign's summary of each varied parameter, as plain data for JSON.

    Of a number: its `unit`; under `worst_margin` and `failed` how that depends on it (`Dependence`), None
    where there is nothing to relate; failures by `groups` of its values from the lowest on.  All p-values of all
    parameters, outcomes and measures together are corrected by Holm's method: `p_holm`, `p_xi_holm`.
    Of what is drawn from names or truth values: the failures by level.
    """
    failed = flags(table, "failed", absent=True)
    margin = numbers(table, "worst_margin")
    if not np.isnan(margin).all():  # one that was lost before it had any ranks below all others
        margin = np.where(np.isnan(margin) & verdicts(table)["lost"], -np.inf, margin)
    summaries: dict[str, Any] = {}
    tested: list[dict[str, Any]] = []
    for name in draw_names(table):
        if not is_number(table, DRAW + name):
            summaries[name] = _levels(table, name, failed)
            continue
        values = numbers(table, DRAW + name)
        summary: dict[str, Any] = {"kind": "number", "unit": unit_of(table, DRAW + name)}
        for outcome, measured in (("worst_margin", margin), ("failed", failed.astype(float))):
            summary[outcome] = None
            related = dependence(values, measured, np.random.default_rng(0))  # the same every time
            if related is not None:
                summary[outcome] = asdict(related)
                tested.append(summary[outcome])
        summary["groups"] = _groups(values, failed)
        summaries[name] = summary
    _correct(tested)
    return summaries


def _correct(tested: Sequence[dict[str, Any]]) -> None:
    """Add to each tested dependence, in place, its p-values corrected for all of them by Holm's method."""
    p_values = []
    for entry in tested:
        p_values += [entry["p"], entry["p_xi"]]
    corrected = iter(holm(p_values))
    for entry in tested:
        entry["p_holm"] = next(corrected)
        entry["p_xi_holm"] = next(corrected)


def drivers(summary: CampaignSummary) -> dict[str, Mapping[str, Any]]:
    """The varied parameters on which an outcome may depend at all, the strongest first.

    They are ordered by how `worst_margin` depends on them, or else `failed`.
    """
    related = {}
    for name, parameter in summary["parameters"].items():
        if parameter.get("worst_margin") or parameter.get("failed"):
            related[name] = parameter

    def weakness(item: tuple[str, Mapping[str, Any]]) -> tuple[float, float]:
        _name, parameter = item
        measured = parameter["worst_margin"] or parameter["failed"]
        p_value = min(measured["p_holm"], measured["p_xi_holm"])
        strength = max(abs(measured["rho"]), measured["xi"])
        return p_value, -strength

    return dict(sorted(related.items(), key=weakness))


def _levels(table: pa.Table, name: str, failed: FlightFlags) -> dict[str, Any]:
    """Return the failures by level of a parameter that is no number."""
    drawn = texts(table, DRAW + name)
    levels = {level: share_of(failed[drawn == level]) for level in sorted(set(drawn))}
    return {"kind": "name", "unit": unit_of(table, DRAW + name), "levels": levels}


def _groups(values: Array, failed: FlightFlags) -> list[dict[str, Any]]:
    """Failures by thirds or fifths of a varied parameter, or by its values if no more; none of few flights."""
    known = np.isfinite(values)
    values = values[known]
    failed = failed[known]
    if values.size >= _FLIGHTS_OF_FIFTHS:
        size = 5
    elif values.size >= _FLIGHTS_OF_THIRDS:
        size = 3
    else:
        return []
    distinct = np.unique(values)
    if distinct.size <= size:
        cuts = distinct[1:]
    else:
        cuts = np.quantile(values, np.arange(1, size) / size)
    group = np.searchsorted(cuts, values, side="right")
    groups = []
    for k in np.unique(group):
        members = group == k
        low = float(values[members].min())
        high = float(values[members].max())
        groups.append({"low": low, "high": high, **share_of(failed[members])})
    return groups


EXAMPLE: Final = "P(violation) < 0.01 @ 95%"
_SHARE_RANGE: Final = (Decimal("1e-9"), 1 - Decimal("1e-9"))
_CONFIDENCE_RANGE: Final = (Decimal("0.5"), Decimal("0.999999"))
_REQUIREMENT: Final = re.compile(
    r"P\s*\((?P<event>[^()]*)\)\s*(?P<operation><=|>=|<|>)\s*(?P<share>[^<>=@]+?)\s*@\s*(?P<confidence>[^@%]+?)\s*%",
    re.IGNORECASE,
)


@dataclass(frozen=True, kw_only=True)
class Requirement:
    """The probability of an event on one side of a share, with this confidence."""

    text: str
    event: CountedEvent
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
    """Judgement of a requirement by the flights."""

    requirement: Requirement
    count: int  # flights in which the event happened
    flights: int
    bound: float  # one-sided, at the requirement's confidence: upper where the probability is to be small, else lower
    holds: bool
    least_flights: int  # that can support it, all of them in its favour
    unaudited: int = 0  # flights that do not count because no constraint was audited

    @property
    def sentence(self) -> str:
        """Return the judgement with its numbers."""
        required = self.requirement
        share = ""
        if self.flights:
            share = f" ({percent(self.count / self.flights)})"
        verdict = "holds" if self.holds else "does not hold"
        side = "most" if required.at_most else "least"
        phrase = (
            f"{required.text} {verdict}: {required.event.text} in {self.count} of "
            f"{count_of(self.flights, 'flight')}{share}, so with {100.0 * required.confidence:g} % confidence at "
            f"{side} {percent(self.bound, digits=3)}."
        )
        if self.unaudited:
            return f"{phrase} Of {count_of(self.unaudited, 'flight')}, {UNAUDITED_ADVICE}."
        if self.flights >= self.least_flights:
            return phrase
        least = count_of(self.least_flights, "flight")
        which = "none" if required.at_most else "all"
        return f"{phrase} It takes at least {least}, {which} of them with that event."

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
    owner = f"requirement {text!r}"
    form = _REQUIREMENT.fullmatch(text)
    if form is None:
        raise InputError(
            f"{owner} must read P(EVENT) OP SHARE @ CONFIDENCE%, with one of < <= > >=, such as {EXAMPLE!r}"
        )
    return Requirement(
        text=text,
        event=parse_event(form["event"].strip()),
        operation=form["operation"],
        share=_number(owner, "share", form["share"], *_SHARE_RANGE),
        confidence=_number(owner, "confidence", form["confidence"] + "%", *_CONFIDENCE_RANGE),
    )


def judge(table: pa.Table, requirement: Requirement) -> Judgement:
    """Judge a requirement by a campaign's flights, `flights.parquet`.

    It holds when the one-sided Clopper-Pearson bound at its confidence is on the required side; so it takes
    flights enough, and no flights support nothing.  Incomplete and unaudited flights do not count
    (`rows.is_counted`).

    Raises:
        UnknownNameError: the table has no column that the event names.
        InputError: the event compares text with a number.
    """
    counted = is_counted(table, requirement.event)
    happened = requirement.event.column(table)[counted]
    count = int(happened.sum())
    flights = happened.size
    bound = _bound(requirement, count, flights)
    holds = flights > 0 and requirement.supported_by(bound)
    least = least_flights(requirement)
    return Judgement(
        requirement=requirement,
        count=count,
        flights=flights,
        bound=bound,
        holds=holds,
        least_flights=least,
        unaudited=int((unaudited(table) & ~counted).sum()),
    )


def least_flights(requirement: Requirement) -> int:
    """The smallest number of flights that can support a requirement, all of them in its favour.

    With n such flights the bound is (1 - confidence)^(1/n) from the far end, which requires
    n = ln(1 - confidence) / ln(1 - share); at a tie, the bound itself as it is computed decides.
    """
    if requirement.at_most:
        per_flight = math.log1p(-requirement.share)
    else:
        per_flight = math.log(requirement.share)
    n = max(1, math.ceil(math.log1p(-requirement.confidence) / per_flight))
    for flights in range(max(1, n - 1), n + 2):
        count = 0 if requirement.at_most else flights
        if requirement.supported_by(_bound(requirement, count, flights)):
            return flights
    return n


def _bound(requirement: Requirement, count: int, flights: int) -> float:
    """The one-sided bound on the probability."""
    if requirement.at_most:
        bounds = upper_bounds
    else:
        bounds = lower_bounds
    return float(bounds(count, flights, requirement.confidence))


def _number(owner: str, name: str, text: str, low: Decimal, high: Decimal) -> float:
    """A share of one, given as such or in percent."""
    in_percent = text.endswith("%")
    with contextlib.suppress(ArithmeticError):
        value = Decimal(text.removesuffix("%").strip())
        if in_percent:
            value /= 100
        if low <= value <= high:
            return float(value)
    rule = f"a number from {low} to {high}".lower()
    if in_percent:
        rule = f"from {(100 * low).normalize():f}% to {(100 * high).normalize():f}%"
    raise ParameterError(owner, name, text, rule)
