"""Fly the campaigns that ship, and remake docs/paper-robustness.md with its figures: `make campaigns`.

The flights take some forty minutes on two quiet cores.  They are saved under
runs/campaigns/, and resumed where they were stopped; remove that folder to fly them all anew.  What is flown is
summed up again by the code as it is.  With --there nothing is flown, and the page is made of the campaigns as they are,
which may have been flown with fewer --flights, or by an earlier version of their files.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from make_numbers import copy_figure, write_page

from quadsim.report.table import Grid, line, section
from scenarios.campaign.manifest import stored_plan
from scenarios.campaign.plan import load_plan
from scenarios.campaign.report import campaign_tables, campaign_text
from scenarios.campaign.report.campaign_curves import sure_splits
from scenarios.campaign.report.comparison_tables import comparison_tables, pairing
from scenarios.campaign.run import Result, fly_campaign
from scenarios.campaign.statistics.comparison import compare
from scenarios.campaign.statistics.wording import interval, percent
from scenarios.commands.campaign_console import progress

PAIR = ("paper-robustness", "paper-robustness-robust")  # flown on the same draws, and compared flight by flight
NOMINAL = "paper-nominal"
NAMES = (*PAIR, NOMINAL)
PAGE = "paper-robustness"


def fly(name: str, *, there: bool) -> Result:
    """One campaign, or what is missing of it; nothing is flown where it is to be taken as it is."""
    directory = Path("runs") / "campaigns" / name
    plan = stored_plan(directory) if there else load_plan(name)
    with progress(enabled=True) as watch:
        return fly_campaign(plan, directory, resume=True, watch=watch)


def violations(results: list[Result]) -> Grid:
    """A line for each campaign: how often a bound was violated, and how often that is at most."""
    lines = []
    for result in results:
        events = result.summary["events"]
        found, lost = events["violation"], events["lost"]
        lines.append(
            line(
                result.summary["campaign"],
                *(str(found["flights"]), str(events["failure"]["count"]), str(lost["count"]), str(found["count"])),
                *(percent(found["share"]), interval(found["lower"], found["upper"])),
                percent(found["upper_one_sided"]),
            )
        )
    return Grid(
        key="violations",
        title="How often a required constraint does not hold",
        head=(
            *("campaign", "flights", "failed", "lost", "violated, or lost"),
            *("share", "95 % interval", "at most, with 95 %"),
        ),
        lines=tuple(lines),
        note="Failed: by what each campaign counts as such; paper-nominal a tilt beyond its bound by more than "
        "0.25 deg, the others a violation as such. Share: of flights that violated a required constraint or were lost. "
        "Intervals are Clopper-Pearson's; the last column is one-sided.",
    )


def part(result: Result) -> str:
    """One campaign's section."""
    name, summary = result.summary["campaign"], result.summary
    parts = " ".join([campaign_text.verdict_sentence(summary) + ".", *campaign_text.campaign_sentences(summary)])
    tables = (
        campaign_tables.event_table(summary),
        campaign_tables.constraint_table(summary),
        *([campaign_tables.split_table(summary)] if campaign_tables.split_table(summary).lines else []),
        campaign_tables.driver_table(summary),
        campaign_tables.worst_table(summary, f"runs/campaigns/{name}"),
    )
    return "\n".join(
        [
            f"## {name}\n\n{parts}\n",
            f"![{name}: convergence, margins, what drives them](campaign-{name}.png)\n",
            *(section(grid, 3) for grid in tables),
        ]
    )


def first_to_break(result: Result) -> str:
    """What the paper's controller fails from first, by a campaign of small errors."""
    summary = result.summary
    parts = [(name, unit, event, split["threshold"]) for event, name, unit, split in sure_splits(summary)]
    found = "No parameter explains it beyond chance"
    if parts:
        first, unit = parts[0][:2]
        steps = sorted((threshold, event) for name, _, event, threshold in parts if name == first)
        listed = ", ".join(
            f"{event} at {threshold:.15g}{'' if unit == '-' else f' {unit}'}" for threshold, event in steps
        )
        found = f"It is {first}. Thresholds along it: {listed}"
    sentences = [*campaign_text.driver_sentences(summary), *campaign_text.split_sentences(summary)]
    return (
        "## What breaks the paper's controller first\n\n"
        f"With small errors alone ({NOMINAL}), {campaign_text.verdict_sentence(summary)}. {found}.\n\n"
        + "".join(f"- {sentence}\n" for sentence in sentences)
    )


def page(results: list[Result]) -> str:
    """The whole page."""
    paper, robust, nominal = results
    comparison = compare(paper.table, robust.table, PAIR)
    machine = paper.manifest["machine"]
    return "\n".join(
        [
            "# How often they fail: the paper's controller, and the robust one\n\nMade by `make campaigns` "
            f"({machine['processor']}, {machine['cores']} cores), from the campaigns that ship. Their files "
            "list the parameters\nand distributions: `paper-robustness-robust` flies the robust controller with the "
            "samples of `paper-robustness`, and `paper-nominal`\nthe paper's controller with small errors alone. "
            "How campaigns work: [campaigns.md](campaigns.md).\n",
            section(violations(results)),
            first_to_break(nominal),
            f"## The one against the other\n\n{comparison.sentence} {pairing(comparison)}\n",
            *(section(grid, 3) for grid in comparison_tables(comparison)),
            *(part(result) for result in results),
        ]
    )


def main() -> None:
    """Fly, and write."""
    parser = argparse.ArgumentParser(description="the campaigns' page")
    parser.add_argument("--there", action="store_true", help="of the flights that are there, flying none")
    options = parser.parse_args()
    results = [fly(name, there=options.there) for name in NAMES]
    for name, result in zip(NAMES, results, strict=True):
        copy_figure(result.directory / "campaign.png", f"campaign-{name}.png", 256)
    write_page(f"{PAGE}.md", page(results))


if __name__ == "__main__":
    main()
