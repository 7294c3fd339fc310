"""A campaign's summary -> sentences that state its outcome in numbers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

from quadsim.report.table import format_number
from scenarios.campaign.report.campaign_curves import sure_splits
from scenarios.campaign.results.table import Summary
from scenarios.campaign.results.verdicts import VERDICTS
from scenarios.campaign.statistics.inference import ALPHA
from scenarios.campaign.statistics.wording import count_of, listing, p_value, percent, share_with_interval

_OUTCOMES = {"worst_margin": "The worst margin", "failed": "Failure"}
_HAPPENED: Final = {
    "failure": ("failures", "failed", "failed"),
    "violation": ("violations", "violated a required constraint", "violated one"),
    "lost": ("losses", "were lost", "was lost"),
}
_MOST_NAMED: Final = 4
_MOST_DRIVERS: Final = 3


def verdict_sentence(summary: Summary) -> str:
    """How many flights failed, and how sure that is: `37 of 1000 flights failed: 3.7 % (95 %: 2.6 to 5.1 %)`."""
    failure = summary["events"]["failure"]
    left_out = summary["flights"] - failure["flights"]
    apart = f"; {count_of(left_out, 'incomplete flight')} not counted" if left_out else ""
    text = f"{failure['count']} of {count_of(failure['flights'], 'flight')} failed"
    if not failure["flights"]:
        return text + apart
    return f"{text}: {share_with_interval(failure, summary['confidence'])}{apart}"


def campaign_sentences(summary: Summary) -> list[str]:
    """What the flights show, one fact each."""
    return [
        *_outcomes(summary),
        *_bounds(summary),
        *_constraints(summary),
        *driver_sentences(summary),
        *split_sentences(summary),
        *_worst(summary),
    ]


def _outcomes(summary: Summary) -> Iterator[str]:
    counts = {verdict: count for verdict, count in summary["verdicts"].items() if count}
    parts = [
        f"{count} {VERDICTS[verdict].phrase_of_one if count == 1 else VERDICTS[verdict].phrase}"
        for verdict, count in counts.items()
    ]
    if len(parts) == 1 and summary["flights"] > 1:
        yield f"All {parts[0].replace(' ', ' flights ', 1)}."
    elif parts:
        yield f"Of {count_of(summary['flights'], 'flight')}, {', '.join(parts)}."


def _bounds(summary: Summary) -> Iterator[str]:
    events = summary["events"]
    if not events["failure"]["flights"]:
        return
    parts = [f"{_bound(events['failure'])} fail"]
    if events["violation"]["count"] != events["failure"]["count"]:
        parts.append(f"{_bound(events['violation'])} violate a required constraint")
    each = " each" if len(parts) > 1 else ""
    yield (
        f"With {100.0 * summary['confidence']:g} % confidence{each}, {' and '.join(parts)} (one-sided Clopper-Pearson)."
    )


def _bound(event: Mapping[str, Any]) -> str:
    """The more informative one-sided bound: from below where most flights had the event."""
    if event["share"] > 0.5:
        return f"at least {percent(event['lower_one_sided'])}"
    return f"at most {percent(event['upper_one_sided'])}"


def _constraints(summary: Summary) -> Iterator[str]:
    broken = {name: found for name, found in summary["constraints"].items() if found["not_satisfied"]["count"]}
    if not broken:
        return
    most = max(found["not_satisfied"]["count"] for found in broken.values())
    names = [name for name, found in broken.items() if found["not_satisfied"]["count"] == most]
    found = broken[names[0]]
    share = share_with_interval(found["not_satisfied"], summary["confidence"])
    if len(names) > 1:
        listed = listing(names, most=_MOST_NAMED)
        yield f"What most often does not hold is {listed}, each in {share} of the flights held to it."
        return
    margin = (
        f"; its worst margin is {format_number(found['worst_margin'])} {found['unit']}, in flight "
        f"{found['worst_flight']}"
        if found["worst_margin"] is not None
        else ""
    )
    yield f"What most often does not hold is {names[0]}, in {share} of the flights held to it{margin}."


def driver_sentences(summary: Summary) -> Iterator[str]:
    """What the outcome depends on, monotonically and otherwise."""
    for outcome, noun in _OUTCOMES.items():
        associations = {name: found.get(outcome) for name, found in summary["parameters"].items()}
        tested = {name: found for name, found in associations.items() if found}
        rising = {name: found for name, found in tested.items() if found["p_holm"] < ALPHA}
        strongest = sorted(rising.items(), key=lambda item: -abs(item[1]["rho"]))[:_MOST_DRIVERS]
        if strongest:
            listed = ", ".join(f"{name} ({found['rho']:+.2f}, {p_value(found['p_holm'])})" for name, found in strongest)
            yield f"{noun} correlates most with {listed}: rank correlation, p-value after Holm's correction."
        others = {name: found for name, found in tested.items() if found["p_xi_holm"] < ALPHA and name not in rising}
        surest = sorted(others.items(), key=lambda item: -item[1]["xi"])[:_MOST_DRIVERS]
        if surest:
            listed = ", ".join(
                f"{name} (xi {found['xi']:.2f}, {p_value(found['p_xi_holm'])}{_turn(summary, name, outcome)})"
                for name, found in surest
            )
            yield (
                f"{noun} {'also ' if strongest else ''}depends on {listed}, without rising or falling throughout: "
                "Chatterjee's xi, p-value after Holm's correction."
            )
        has_threshold = outcome == "failed" and any(event == "failure" for event, *_ in sure_splits(summary))
        if tested and not (strongest or surest or has_threshold):
            yield (
                f"{noun} depends on no varied parameter beyond chance (rank correlation, and Chatterjee's xi for any "
                "dependence; 5 % after Holm's correction for all tests)."
            )


def _turn(summary: Summary, name: str, outcome: str) -> str:
    """Where the worst margin turns over a varied parameter."""
    turn = summary["parameters"][name]["turn"] if outcome == "worst_margin" else None
    return "" if turn is None else f", {turn['kind']} near {turn['at']:.3g}"


def split_sentences(summary: Summary) -> Iterator[str]:
    """Where the flights with an event are, by the surest threshold."""
    reported: set[str] = set()
    for event, name, unit, split in sure_splits(summary):
        if event in reported:
            continue
        reported.add(event)
        worse, better, side = split["high"], split["low"], "above"
        if worse["share"] < better["share"]:
            worse, better, side = better, worse, "up to"
        at = f"{name} = {split['threshold']:.15g}{'' if unit == '-' else f' {unit}'}"
        noun, verb, one = _HAPPENED[event]
        head = f"{noun.capitalize()} cluster"
        if not better["count"]:
            head = f"All {worse['count']} {noun} are" if worse["count"] > 1 else f"The one flight that {one} is"
        yield (
            f"{head} {side} {at}: {_part(worse)} flights {verb} there ({_ends(worse, summary)}), and {_part(better)} "
            f"{'up to it' if side == 'above' else 'above it'} ({_ends(better, summary)}); {p_value(split['p_holm'])}, "
            "corrected for the choice of the threshold and for all tests."
        )


def _part(share: Mapping[str, Any]) -> str:
    return f"{share['count']} of {share['flights']}"


def _ends(share: Mapping[str, Any], summary: Summary) -> str:
    return share_with_interval(share, summary["confidence"]).replace(" (", "; ").removesuffix(")")


def _worst(summary: Summary) -> Iterator[str]:
    if not summary["worst"]:
        return
    worst = summary["worst"][0]
    margin = worst["worst_margin"]
    if margin is None:
        suffix = ""
    elif worst["verdict"] == "lost" and margin >= 0.0:
        suffix = " before any required constraint was violated"
    else:
        suffix = f", with a worst margin of {format_number(margin)} ({worst['worst_constraint']})"
    yield f"The worst flight is number {worst['flight']}: {worst['verdict']}{suffix}."
