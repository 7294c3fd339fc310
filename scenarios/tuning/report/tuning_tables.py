"""A tuning's summary -> sentences and tables."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from quadsim.report.table import ABSENT, Cell, Grid, Mark, format_number, line
from scenarios.campaign.statistics.wording import count_of, label, p_value, signed_points
from scenarios.tuning.spec import START

Summary = Mapping[str, Any]
_MOST_SHOWN: Final = 12


def verdict_sentence(summary: Summary) -> str:
    """What is better, by how much, on fresh draws."""
    if summary["answer"] == START:
        both = " in both objectives" if len(summary["objectives"]) == 2 else ""
        return f"No candidate of {summary['trials']} was better than the start{both}"
    parts = [
        f"{each['name']} {format_number(each['fresh_best'])} against {format_number(each['fresh_start'])}"
        f"{'' if each['unit'] == '-' else ' ' + each['unit']} ({_percent(each['kept'])})"
        for each in summary["objectives"]
    ]
    return f"Candidate {summary['answer']} on fresh draws: {', '.join(parts)}"


def sentences(summary: Summary) -> list[str]:
    """What the search and the fresh flights show, one fact each."""
    fresh, event = summary["fresh"], summary["event"]
    feasible = sum(each["feasible"] for each in summary["candidates"])
    found = [
        f"{count_of(summary['trials'], 'candidate')} and the start flew {summary['search_flights']} flights, each the "
        f"first of the same {summary['draws']} draws; {feasible} of them "
        f"held {summary['counted']} there by the share of flights."
    ]
    for each in summary["objectives"] if summary["answer"] != START else ():
        if each["kept"] is None:
            found.append(f"No fresh draw was completed by both, so nothing is known of {each['name']}.")
            continue
        ends = f"{format_number(each['lower'])} to {format_number(each['upper'])}"
        unit = "" if each["unit"] == "-" else f" {each['unit']}"
        found.append(
            f"{each['name']}: {_percent(each['kept'])} on {count_of(each['pairs'], 'fresh draw')}, mean difference of "
            f"the pairs {format_number(each['mean_difference'])}{unit} (95 %: {ends}). The draws that chose it "
            f"promised {_percent(each['promised'])}: {_optimism(each['optimism'])}."
        )
    found.append(f"Of the answer: {fresh['best']['requirement']['sentence']}")
    if summary["answer"] != START:
        found.append(f"Of the start: {fresh['start']['requirement']['sentence']}")
        found.append(
            f"{event['sentence'][0].upper()}{event['sentence'][1:]} (McNemar's exact test, {p_value(event['p'])}; "
            f"difference {signed_points(event['difference'])} percentage points, 95 %: {signed_points(event['lower'])} "
            f"to {signed_points(event['upper'])})."
        )
    return found


def tables(summary: Summary) -> list[Grid]:
    """Values, objectives, and the best candidates."""
    return [values_table(summary), objective_table(summary), candidate_table(summary)]


def values_table(summary: Summary) -> Grid:
    """What was searched, where, and what was found."""
    lines = []
    for entry in summary["search"]:
        bounds = entry.get("values") or [entry["low"], entry["high"]]
        ends = ", ".join(map(_value, bounds)) if "values" in entry else f"{_value(bounds[0])} to {_value(bounds[1])}"
        how = {"log_uniform": ", log", "integer": ", whole"}.get(entry["distribution"], "")
        times = "times the start's" if entry["relative"] else ""
        fields = Cell(text=", ".join(entry["fields"]), mark=Mark.CODE)
        lines.append(
            line(label(entry["name"], entry["unit"]), fields, f"{ends}{how} {times}".strip(), _value(entry["start"]),
                 _value(entry["best"]))
        )  # fmt: skip
    head = ("name", "fields", "range", "start", "best")
    return Grid(key="values", title="What was searched", head=head, lines=tuple(lines))


def objective_table(summary: Summary) -> Grid:
    """The objectives on the draws that chose the answer, and on fresh ones."""
    lines = [
        line(
            label(each["name"], each["unit"]),
            *(each["statistic"], format_number(each["start"]), format_number(each["best"]), _percent(each["promised"])),
            *(format_number(each["fresh_start"]), format_number(each["fresh_best"]), _percent(each["kept"])),
            "-" if each["optimism"] is None else f"{100.0 * each['optimism']:+.1f}",
        )
        for each in summary["objectives"]
    ]
    return Grid(
        key="objectives",
        title="The draws that chose it, and fresh ones",
        head=(
            *("objective", "of flights", "start, search", "best, search", "promised"),
            *("start, fresh", "best, fresh", "confirmed", "optimism [points]"),
        ),
        lines=tuple(lines),
        note="Search: over the draws that chose the answer, so that luck chose with them. Fresh: over draws that chose "
        "nothing, of the pairs that both completed. Optimism: promised improvement minus confirmed one, in "
        "percentage points of the start; above 0, the search promised too much.",
    )


def candidate_table(summary: Summary) -> Grid:
    """The candidates that flew all draws, the best first."""
    whole = [each for each in summary["candidates"] if each["flights"] == summary["draws"]]
    order = sorted(
        whole, key=lambda each: (not each["feasible"], each["excess"] > 0 and each["excess"], each["values"])
    )
    names = [entry["name"] for entry in summary["search"]]
    lines = []
    for each in order[:_MOST_SHOWN]:
        on_front = each["candidate"] in summary["front"]
        title = "start" if each["candidate"] == START else str(each["candidate"])
        values = [
            Cell(text=format_number(value), mark=Mark.BEST if on_front else Mark.NONE) for value in each["values"]
        ]
        lines.append(
            line(title, *values, f"{each['count']} of {each['flights']}", *(_value(each["search"][n]) for n in names))
        )
    objectives = (label(each["name"], each["unit"]) for each in summary["objectives"])
    event = summary["counted"].partition("(")[2].partition(")")[0]
    return Grid(
        key="candidates",
        title="Candidates that flew all draws of the search",
        head=("candidate", *objectives, event, *names),
        lines=tuple(lines),
        note=f"Feasible ones first, at most {_MOST_SHOWN}; bold: of the Pareto front, or the best.",
    )


def importance_table(summary: Summary) -> Grid:
    """How much each field matters to each objective."""
    found = summary["importance"]
    lines = []
    for entry in summary["search"]:
        shares = (each.get(entry["name"]) for each in found.values())
        lines.append(line(entry["name"], *(ABSENT if share is None else f"{100.0 * share:.0f} %" for share in shares)))
    return Grid(
        key="importance",
        title="What matters",
        head=("field", *found),
        lines=tuple(lines),
        note="PED-ANOVA (Watanabe, Bansal and Hutter, 2023): how far the best tenth of the feasible candidates differs "
        "from all of them, field by field, as shares of the sum. The search crowds where it is good, so that few "
        "candidates show little.",
    )


def _percent(share: float | None) -> str:
    return ABSENT if share is None else f"{100.0 * share:+.1f} %"


def _optimism(share: float | None) -> str:
    if share is None:
        return "a share of nothing"
    points = f"{abs(100.0 * share):.1f} points"
    return f"the search was too optimistic by {points}" if share > 0.0 else f"it promised {points} less than confirmed"


def _value(value: object) -> str:
    if value is None:
        return ABSENT
    return format_number(value) if isinstance(value, int | float) and not isinstance(value, bool) else str(value)
