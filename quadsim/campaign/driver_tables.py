"""What goes with a campaign's outcome -> tables."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from quadsim.campaign.curves import Association, drivers, sure_splits
from quadsim.campaign.estimates import Summary
from quadsim.campaign.statistics import ALPHA
from quadsim.campaign.wording import interval, label, p_value, percent
from quadsim.table import ABSENT, Cell, Grid, Mark, format_number

_GROUPS: Final = {
    3: ("lowest third", "middle", "highest third"),
    5: ("lowest fifth", "second", "third", "fourth", "highest fifth"),
}


def driver_table(summary: Summary) -> Grid:
    """How each drawn number goes with the worst margin and with failure."""
    told = drivers(summary)
    lines = []
    for driver in told:
        cells = [Cell(text=driver.label)]
        for outcome, found in (("worst_margin", driver.margin), ("failed", driver.failure)):
            cells += _association(found, summary["parameters"][driver.name].get(outcome))
        lines.append(tuple(cells))
    return Grid(
        key="drivers-table",
        title="What goes with the outcome",
        head=(
            "drawn number",
            *("worst margin: rho", "after Holm", "xi", "after Holm"),
            *("failure: rho", "after Holm", "xi", "after Holm"),
        ),
        lines=tuple(lines),
        note=(
            "rho: Spearman's rank correlation, which sees what rises or falls throughout and is blind to a number that "
            "does harm at both of its ends. xi: Chatterjee's (2021), which sees any dependence: about 0 for none, 1 "
            "where the drawn number alone decides. p-values are corrected by Holm's method for all tests of the "
            f"campaign, those of thresholds included; bold: beyond chance at {100.0 * ALPHA:g} %. A flight that was "
            "lost before it had a margin ranks below all others."
        ),
    )


def split_table(summary: Summary) -> Grid:
    """The thresholds on drawn numbers that tell flights with an event from those without, beyond chance."""
    told = list(sure_splits(summary))
    sure = f"{100.0 * summary['confidence']:g} % interval"
    lines = tuple(
        _line(
            event,
            f"{name} > {split['threshold']:.15g}{'' if unit == '-' else f' {unit}'}",
            *_side(split["low"]),
            *_side(split["high"]),
            f"{format_number(split['below'])} and {format_number(split['above'])}",
            p_value(split["p_holm"]),
        )
        for event, name, unit, split in told
    )
    return Grid(
        key="splits",
        title="Where it happens: one threshold",
        head=("event", "threshold", "up to it", sure, "above it", sure, "between flights at", "after Holm"),
        lines=lines,
        note=(
            "Of each drawn number the threshold at which Fisher's exact test is surest. p: the chance that the best of "
            "all thresholds is as sure where the event has nothing to do with the number, exact, then corrected by "
            "Holm's method for all tests of the campaign. The intervals, Clopper-Pearson's, take the threshold as "
            "given: it was chosen by these flights, so they look a little sharper than they are. Thresholds on numbers "
            "beyond the first of an event may be the same flights seen again."
        ),
    )


def group_table(summary: Summary) -> Grid:
    """How often flights failed over each drawn number, from its lowest values on; of none or all failed, no lines."""
    failure = summary["events"]["failure"]
    told = {
        name: found
        for name, found in summary["parameters"].items()
        if found.get("groups") and 0 < failure["count"] < failure["flights"]
    }
    size = max((len(found["groups"]) for found in told.values()), default=0)
    lines = tuple(
        _line(
            label(name, found["unit"]),
            *(_group(group) for group in found["groups"]),
            *[ABSENT] * (size - len(found["groups"])),
        )
        for name, found in told.items()
    )
    return Grid(
        key="groups",
        title="Failures over each drawn number",
        head=("drawn number", *_GROUPS.get(size, [f"{k + 1}." for k in range(size)])),
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
            _line(
                *(level, f"{share['count']} of {share['flights']}"),
                *(percent(share["share"]), interval(share["lower"], share["upper"])),
            )
            for level, share in found["levels"].items()
        )
        head = (name, "failed", "share", f"{100.0 * summary['confidence']:g} % interval")
        grids.append(Grid(key=f"levels-{len(grids)}", title=f"Failures by {name}", head=head, lines=lines))
    return grids


def _association(found: Association | None, told: Mapping[str, Any] | None) -> tuple[Cell, ...]:
    if found is None or told is None:
        return _line(*[ABSENT] * 4)
    return (
        Cell(text=f"{found.rho:+.2f}", mark=Mark.BEST if found.rho_is_sure else Mark.NONE),
        Cell(text=p_value(told["p_holm"])),
        Cell(text=f"{found.xi:.2f}", mark=Mark.BEST if found.xi_is_sure else Mark.NONE),
        Cell(text=p_value(told["p_xi_holm"])),
    )


def _side(share: Mapping[str, Any]) -> tuple[str, str]:
    told = f"{share['count']} of {share['flights']} ({percent(share['share'])})"
    return told, interval(share["lower"], share["upper"])


def _group(group: Mapping[str, Any]) -> str:
    low, high = format_number(group["low"]), format_number(group["high"])
    return f"{low if low == high else f'{low} to {high}'}: {percent(group['share'])}"


def _line(*texts: str) -> tuple[Cell, ...]:
    return tuple(Cell(text=text) for text in texts)
