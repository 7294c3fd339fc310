"""A campaign's summary and manifest -> tables."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from quadsim.report.table import ABSENT, Cell, Grid, Mark, format_number, line
from scenarios.campaign.report.campaign_curves import drivers, sure_splits
from scenarios.campaign.results.table import Summary
from scenarios.campaign.results.verdicts import HARMLESS, INCOMPLETE
from scenarios.campaign.statistics.inference import ALPHA
from scenarios.campaign.statistics.wording import interval, label, p_value, percent

_MARKS: Final = {HARMLESS: Mark.NONE, INCOMPLETE: Mark.WARN}
_GROUPS: Final = {
    3: ("lowest third", "middle", "highest third"),
    5: ("lowest fifth", "second", "third", "fourth", "highest fifth"),
}


def event_table(summary: Summary, failure: Sequence[str] = ()) -> Grid:
    """How often each event happened; `failure` names the events that count as failure."""
    lines = tuple(
        line(
            *(name, str(found["count"]), *_shares(found)),
            *(percent(found["lower_one_sided"]), percent(found["upper_one_sided"])),
        )
        for name, found in summary["events"].items()
    )
    sure = f"{100.0 * summary['confidence']:g} %"
    counted = f" ({', '.join(failure)})" if failure else ""
    return Grid(
        key="events",
        title="How often",
        head=("event", "flights", "share", f"{sure} interval", f"at least, with {sure}", f"at most, with {sure}"),
        lines=lines,
        note=(
            f"Failure: what the campaign counts as such{counted}. Violation: a required constraint did not hold, or "
            "the flight was lost, raised an error or met a limit of time or memory. Incomplete: the flight ended "
            "before it reached a required constraint, without a failure; the shares of failure and violation leave it "
            "out. Intervals are "
            "Clopper-Pearson's: two-sided, and "
            "one-sided in the last two columns. They take flights as independent draws; draws spread evenly (Latin "
            "hypercube, Sobol', Halton) make the estimates more precise than that, and a grid gives the share over its "
            "own points."
        ),
    )


def constraint_table(summary: Summary) -> Grid:
    """How often each constraint did not hold, and by how much at worst."""
    lines = []
    for name, found in summary["constraints"].items():
        failed = found["not_satisfied"]
        mark = Mark.BAD if failed["count"] else Mark.NONE
        margin = ABSENT if found["worst_margin"] is None else f"{format_number(found['worst_margin'])} {found['unit']}"
        flight = ABSENT if found["worst_flight"] is None else str(found["worst_flight"])
        count = Cell(text=str(failed["count"]), mark=mark)
        lines.append(line(name, count, *_shares(failed), margin, flight))
    return Grid(
        key="constraints",
        title="Constraints",
        head=(
            *("constraint", "flights that did not hold it", "share"),
            *(f"{100.0 * summary['confidence']:g} % interval", "worst margin", "in flight"),
        ),
        lines=tuple(lines),
        note="Margins are signed, at the physics rate and without the tolerance; negative is beyond the bound. Shares "
        "are of the flights that reached the constraint or were lost before it. Margins of a lost flight end where it "
        "was aborted: what came after is not in them.",
    )


def metric_table(summary: Summary) -> Grid:
    """How every metric is distributed."""
    measures = ("mean", "sd", "min", "p5", "p50", "p95", "p99", "max")
    lines = tuple(
        line(
            label(name, found["unit"]), *(format_number(found[measure]) for measure in measures), str(found["flights"])
        )
        for name, found in summary["metrics"].items()
    )
    return Grid(
        key="metrics",
        title="All metrics",
        head=("metric", *measures, "flights"),
        lines=lines,
        note="Over the flights that have the number, lost ones included. worst_margin: the smallest margin of the "
        "required constraints, tolerance included, as a share of half the constraint's band: 1 in the middle, 0 at the "
        "end of what is allowed, negative beyond. What is measured of a lost flight ends where it was aborted.",
    )


def worst_table(summary: Summary, directory: str) -> Grid:
    """The worst flights, and how to fly one again."""
    worst = summary["worst"]
    lines = tuple(
        line(
            str(flight["flight"]),
            Cell(text=flight["verdict"], mark=_MARKS.get(flight["verdict"], Mark.BAD)),
            *(format_number(flight["worst_margin"]), flight["worst_constraint"] or ABSENT),
            format_number(flight["duration"]),
            Cell(text=flight["reason"] or ABSENT, mark=Mark.TEXT),
        )
        for flight in worst
    )
    again = f" To fly one of them again: {replay_command(directory, worst[0]['flight'])}" if worst else ""
    return Grid(
        key="worst",
        title="Worst flights",
        head=("flight", "verdict", "worst margin", "constraint", "flown [s]", "reason"),
        lines=lines,
        note="Lost flights first, then those that raised an error, took too long or too much memory, violated a "
        "constraint, ended before one was reached, and held all; among these, "
        "failed ones first, then the smaller worst margin. Margins of a lost flight end where it was aborted." + again,
    )


def worst_draws_table(summary: Summary) -> Grid:
    """Parameters of the worst flights, a column for each."""
    worst = summary["worst"]
    lines = tuple(
        line(label(name, found["unit"]), *(_value(flight["draws"][name]) for flight in worst))
        for name, found in summary["parameters"].items()
    )
    return Grid(
        key="worst-draws",
        title="Their parameters",
        head=("flight", *(str(flight["flight"]) for flight in worst)),
        lines=lines if worst else (),
    )


def manifest_table(manifest: Mapping[str, Any]) -> Grid:
    """How the campaign was made, a line for each entry."""
    lines = tuple(line(key, Cell(text=value, mark=Mark.TEXT)) for key, value in _flat(manifest))
    return Grid(key="manifest", title="How it was made", head=("", ""), lines=lines)


def replay_command(directory: str, flight: int) -> str:
    """The command that flies one flight of a campaign again."""
    return f"quadsim replay {shlex.quote(directory)} --flight {flight}"


def _flat(entries: Mapping[str, Any], head: str = "") -> Iterator[tuple[str, str]]:
    for key, value in entries.items():
        name = f"{head}{key}"
        if isinstance(value, Mapping):
            yield from _flat(value, f"{name}.")
        elif isinstance(value, list | tuple):
            yield name, ", ".join(map(_value, value)) or ABSENT
        else:
            yield name, _value(value)


def _value(value: Any) -> str:
    if value is None:
        return ABSENT
    if isinstance(value, bool):
        return "true" if value else "false"
    return format_number(value) if isinstance(value, float) else str(value)


def _shares(found: Mapping[str, Any]) -> tuple[str, str]:
    return percent(found["share"]), interval(found["lower"], found["upper"])


def driver_table(summary: Summary) -> Grid:
    """How the worst margin and failure depend on each varied parameter."""
    lines = (
        line(label(name, found["unit"]), *_association(found["worst_margin"]), *_association(found["failed"]))
        for name, found in drivers(summary).items()
    )
    return Grid(
        key="drivers-table",
        title="Which parameters matter",
        head=(
            "varied parameter",
            *("worst margin: rho", "after Holm", "xi", "after Holm"),
            *("failure: rho", "after Holm", "xi", "after Holm"),
        ),
        lines=tuple(lines),
        note=(
            "rho: Spearman's rank correlation, which sees what rises or falls throughout and is blind to a parameter "
            "that does harm at both of its ends. xi: Chatterjee's (2021), which sees any dependence: about 0 for none, "
            "1 where the varied parameter alone decides. p-values are corrected by Holm's method for all tests of the "
            f"campaign, those of thresholds included; bold: beyond chance at {100.0 * ALPHA:g} %. A flight that was "
            "lost before it had a margin ranks below all others."
        ),
    )


def split_table(summary: Summary) -> Grid:
    """The thresholds on varied parameters that separate flights with an event from those without, beyond chance."""
    listed = list(sure_splits(summary))
    sure = f"{100.0 * summary['confidence']:g} % interval"
    lines = tuple(
        line(
            event,
            f"{name} > {split['threshold']:.15g}{'' if unit == '-' else f' {unit}'}",
            *_side(split["low"]),
            *_side(split["high"]),
            f"{format_number(split['below'])} and {format_number(split['above'])}",
            p_value(split["p_holm"]),
        )
        for event, name, unit, split in listed
    )
    return Grid(
        key="splits",
        title="Where it happens: one threshold",
        head=("event", "threshold", "up to it", sure, "above it", sure, "between flights at", "after Holm"),
        lines=lines,
        note=(
            "Of each varied parameter the threshold at which Fisher's exact test is surest. p: the chance that the "
            "best of all thresholds is as sure where the event does not depend on the parameter, exact, then corrected "
            "by Holm's method for all tests of the campaign. The intervals, Clopper-Pearson's, take the threshold as "
            "given: it was chosen by these flights, so they look a little sharper than they are. Thresholds on "
            "parameters beyond the first of an event may be the same flights seen again."
        ),
    )


def group_table(summary: Summary) -> Grid:
    """How often flights failed over each varied parameter, lowest values first; of none or all failed, no lines."""
    failure = summary["events"]["failure"]
    listed = {
        name: found
        for name, found in summary["parameters"].items()
        if found.get("groups") and 0 < failure["count"] < failure["flights"]
    }
    size = max((len(found["groups"]) for found in listed.values()), default=0)
    lines = tuple(
        line(
            label(name, found["unit"]),
            *(_group(group) for group in found["groups"]),
            *[ABSENT] * (size - len(found["groups"])),
        )
        for name, found in listed.items()
    )
    return Grid(
        key="groups",
        title="Failures over each varied parameter",
        head=("varied parameter", *_GROUPS.get(size, [f"{k + 1}." for k in range(size)])),
        lines=lines,
        note="Share of failed flights among those with such a value; flights are in groups of about equal size, or by "
        f"value where there are few values. Over all flights it is {percent(failure['share'])}.",
    )


def level_tables(summary: Summary) -> list[Grid]:
    """How often flights failed with each name or truth value that was drawn."""
    grids: list[Grid] = []
    for parameter, found in summary["parameters"].items():
        name = label(parameter, found["unit"])
        if found["kind"] == "number" or not found["levels"]:
            continue
        lines = tuple(
            line(level, f"{share['count']} of {share['flights']}", *_shares(share))
            for level, share in found["levels"].items()
        )
        head = (name, "failed", "share", f"{100.0 * summary['confidence']:g} % interval")
        grids.append(Grid(key=f"levels-{len(grids)}", title=f"Failures by {name}", head=head, lines=lines))
    return grids


def _association(found: Mapping[str, Any] | None) -> tuple[Cell, ...]:
    if found is None:
        return line(*[ABSENT] * 4)
    return line(
        Cell(text=f"{found['rho']:+.2f}", mark=Mark.BEST if found["p_holm"] < ALPHA else Mark.NONE),
        p_value(found["p_holm"]),
        Cell(text=f"{found['xi']:.2f}", mark=Mark.BEST if found["p_xi_holm"] < ALPHA else Mark.NONE),
        p_value(found["p_xi_holm"]),
    )


def _side(share: Mapping[str, Any]) -> tuple[str, str]:
    listed = f"{share['count']} of {share['flights']} ({percent(share['share'])})"
    return listed, interval(share["lower"], share["upper"])


def _group(group: Mapping[str, Any]) -> str:
    low, high = format_number(group["low"]), format_number(group["high"])
    return f"{low if low == high else f'{low} to {high}'}: {percent(group['share'])}"
