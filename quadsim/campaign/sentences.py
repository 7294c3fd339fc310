"""A campaign's summary -> sentences that state its outcome in numbers."""

from __future__ import annotations

from collections.abc import Iterator

from quadsim.campaign.curves import ALPHA
from quadsim.campaign.estimates import Summary
from quadsim.campaign.wording import count_of, p_value, percent, share_with_interval
from quadsim.table import format_number

_OUTCOMES = {"worst_margin": "The worst margin", "failed": "Failure"}
_VERDICTS = {
    "satisfied": "held every required constraint",
    "violated": "violated at least one",
    "lost": "were lost",
    "error": "raised an error",
}


def verdict_sentence(summary: Summary) -> str:
    """How many flights failed, and how sure that is: `37 of 1000 flights failed: 3.7 % (95 %: 2.6 to 5.1 %)`."""
    failure = summary["events"]["failure"]
    told = f"{failure['count']} of {count_of(failure['flights'], 'flight')} failed"
    return f"{told}: {share_with_interval(failure, summary['confidence'])}" if failure["flights"] else told


def campaign_sentences(summary: Summary) -> list[str]:
    """What the flights show, one fact each."""
    return [*_outcomes(summary), *_bounds(summary), *_constraints(summary), *_drivers(summary), *_worst(summary)]


def _outcomes(summary: Summary) -> Iterator[str]:
    parts = [f"{count} {_VERDICTS[verdict]}" for verdict, count in summary["verdicts"].items() if count]
    if len(parts) == 1 and summary["flights"] > 1:
        yield f"All {parts[0].replace(' ', ' flights ', 1)}."
    elif parts:
        yield f"Of {count_of(summary['flights'], 'flight')}, {', '.join(parts)}."


def _bounds(summary: Summary) -> Iterator[str]:
    if not summary["flights"]:
        return
    events = summary["events"]
    parts = [f"{percent(events['failure']['upper_one_sided'])} fail"]
    if events["violation"]["count"] != events["failure"]["count"]:
        parts.append(f"{percent(events['violation']['upper_one_sided'])} violate a required constraint")
    each = " each" if len(parts) > 1 else ""
    yield (
        f"With {100.0 * summary['confidence']:g} % confidence{each}, at most {' and at most '.join(parts)} "
        "(one-sided Clopper-Pearson)."
    )


def _constraints(summary: Summary) -> Iterator[str]:
    broken = {name: found for name, found in summary["constraints"].items() if found["not_satisfied"]["count"]}
    if not broken:
        return
    name, found = max(broken.items(), key=lambda item: item[1]["not_satisfied"]["count"])
    share = share_with_interval(found["not_satisfied"], summary["confidence"])
    margin = (
        f"; its worst margin is {format_number(found['worst_margin'])} {found['unit']}, in flight "
        f"{found['worst_flight']}"
        if found["worst_margin"] is not None
        else ""
    )
    yield f"What most often does not hold is {name}, in {share} of all flights{margin}."


def _drivers(summary: Summary) -> Iterator[str]:
    if not any(found["kind"] == "number" for found in summary["parameters"].values()):
        return
    for outcome, noun in _OUTCOMES.items():
        told = {name: found.get(outcome) for name, found in summary["parameters"].items()}
        tested = {name: found for name, found in told.items() if found}
        sure = {name: found for name, found in tested.items() if found["p_holm"] < ALPHA}
        strongest = sorted(sure.items(), key=lambda item: -abs(item[1]["rho"]))[:3]
        if strongest:
            listed = ", ".join(f"{name} ({found['rho']:+.2f}, {p_value(found['p_holm'])})" for name, found in strongest)
            yield f"{noun} goes most with {listed}: rank correlation, p-value after Holm's correction."
        elif tested:
            yield f"{noun} goes with no drawn number beyond chance (rank correlation, 5 % after Holm's correction)."


def _worst(summary: Summary) -> Iterator[str]:
    if not summary["worst"]:
        return
    worst = summary["worst"][0]
    margin = worst["worst_margin"]
    told = (
        f", with a worst margin of {format_number(margin)} ({worst['worst_constraint']})" if margin is not None else ""
    )
    yield f"The worst flight is number {worst['flight']}: {worst['verdict']}{told}."
