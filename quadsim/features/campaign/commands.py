"""The commands `quadsim campaign` and `quadsim replay`, and `quadsim.sweep`.

A campaign draws parameters of a scenario at random and flies each draw (`quadsim.rollout.many`): how often does it
fail, with which confidence?  A sweep flies every combination of given values.  `replay` flies one draw again.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple, TypeAlias

from cyclopts import Parameter

from quadsim.errors import InputError, ParameterError
from quadsim.features.arguments import (
    Changes,
    ComparedName,
    Fields,
    File,
    Flag,
    Flown,
    ScenarioName,
    UserCode,
    UserForces,
    Watched,
    Whole,
)
from quadsim.scenarios.catalogue import campaign_names

if TYPE_CHECKING:
    import pyarrow as pa

    from quadsim.features.campaign.campaign import CampaignResult, Replay, Watch
    from quadsim.features.campaign.paired import PairedComparison
    from quadsim.features.campaign.plan import Plan
    from quadsim.features.campaign.sweep import Sweep
    from quadsim.flight.audit import Limit
    from quadsim.scenarios.schema.scenario import Scenario

    CampaignName: TypeAlias = ScenarioName
    Variations: TypeAlias = Sequence[Mapping[str, Any]]
else:
    from quadsim.features.arguments import one_of

    CampaignResult = PairedComparison = Replay = Any
    CampaignName = one_of(campaign_names)
    Variations = Annotated[Any, Parameter(parse=False)]

_log: Final = logging.getLogger("quadsim")


def sweep(
    scenario: ScenarioName,
    values: Mapping[Any, Sequence[Any]],
    *,
    controller: object = None,
    forces: Sequence[object] = (),
    workers: int | None = None,
    progress: bool = True,
) -> Sweep:
    """Fly a scenario for every combination of the values of some fields, always with the scenario's seed.

    Args:
        scenario: the scenario, or its name or file.
        values: values to try, by dotted path; the fields of a tuple of paths vary together, with one common value or a
            tuple of one value per field.
        controller: as in `fly`; a class or a function of a module that other processes can import.
        forces: as in `fly`; importable, like the controller.
        workers: number of processes (default: one per usable core).
        progress: as in `fly`.

    Returns:
        A table with a row per flight, in the order of the combinations, the last field varying fastest.

    Raises:
        InputError: a value is not allowed, or the controller cannot be sent to other processes.

    Examples:
        >>> import quadsim
        >>> scenario = quadsim.load("hover").replace({"duration": 1.0})
        >>> table = quadsim.sweep(scenario, {"controller.horizon": [20, 40]}, workers=1)
        >>> table["controller.horizon"].tolist(), table["verdict"].tolist()
        ([20.0, 40.0], ['satisfied', 'satisfied'])
        >>> both = ("controller.output_bounds.roll", "controller.output_bounds.pitch")
        >>> tilt = quadsim.sweep(scenario, {both: [[-2.0, 2.0], [-5.0, 5.0]]}, workers=1)
        >>> tilt["controller.output_bounds.pitch.1"].tolist(), tilt["margin.roll"].round(3).tolist()
        ([2.0, 5.0], [2.0, 5.0])
    """
    from quadsim.console.progress import reporting
    from quadsim.features.campaign.sweep import fly_sweep
    from quadsim.scenarios.loading import load_scenario
    from quadsim.scenarios.user_code import importable

    with reporting(progress, "the sweep") as report:
        swept = importable(load_scenario(scenario), controller, forces)
        return fly_sweep(swept, values, workers, report)


def campaign(
    campaign: CampaignName,
    /,
    *,
    out: File | None = None,
    overwrite: Flag = False,
    workers: Whole | None = None,
    cluster: str | None = None,
    resume: Flag = False,
    flights: Whole | None = None,
    until_width: float | None = None,
    require: Sequence[str] = (),
    report: bool = True,
    junit: File | None = None,
    changes: Changes = (),
    seed: Whole | None = None,
    vary: Variations = (),
    fields: Fields = None,
    controller: UserCode = None,
    forces: UserForces = (),
    progress: Watched = True,
) -> CampaignResult:
    """Fly a scenario many times with randomly drawn parameters.

    Args:
        campaign: campaign's name, or path to a TOML file; in Python also a scenario, with `vary` and `fields`.
        out: campaign directory (default: runs/campaigns/NAME).
        overwrite: replace an earlier output, if its summary.json lists every file in the directory.
        workers: processes (default: one per core).
        cluster: fly on a Dask cluster: its scheduler's address, tcp://HOST:PORT.
        resume: continue the flights in this directory.
        flights: number of flights, in place of the file's.
        until_width: stop once the 95 % interval of the failure probability is this narrow, e.g. 0.05.
        require: exit 1 unless the flights support this statement, e.g. "P(violation) < 0.01 @ 95%"; may be repeated.
        report: write the report, an HTML page.
        junit: also write the requirements' verdicts as JUnit XML.
        changes: replace a field of the scenario, e.g. --set controller.horizon=30; may be repeated.
        seed: replace the seed of all draws.
        vary: with a scenario: the quantities to draw, entries as `[[vary]]` of a campaign file.
        fields: with a scenario: other fields of a campaign file, such as `name`, `failure` or `sampling`.
        controller: with a scenario: as in `sweep`.
        forces: with a scenario: as in `sweep`.
        progress: whether to show a bar on a terminal, and elsewhere a line every ten seconds.

    Returns:
        The results: `table` (a row per flight), `summary` (estimates with their intervals), `judgements` (of the
        requirements), and the `directory`.

    Raises:
        InputError: the campaign, or one of its flights, cannot be set up.
        OutputError: the directory already has a campaign, or cannot be written.
        KeyboardInterrupt: the user stopped it; the flights so far are kept, and `resume` continues it.

    Examples:
        >>> import tempfile, quadsim
        >>> scenario = quadsim.load("hover").replace({"duration": 1.0})
        >>> mass = {"name": "mass", "fields": ["vehicle.mass"], "distribution": "uniform", "low": 4.0, "high": 4.4}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     result = quadsim.campaign(scenario, vary=[mass], flights=3, workers=1, out=folder + "/mass")
        >>> result.table["verdict"].to_pylist()
        ['satisfied', 'satisfied', 'satisfied']
    """
    from quadsim.console.junit import junit_file, write_junit
    from quadsim.console.results import after
    from quadsim.features.campaign.campaign import fly_campaign
    from quadsim.features.campaign.events import parse_event
    from quadsim.features.campaign.statistics import judge, parse_requirement
    from quadsim.outputs import absolute

    if junit is not None and not require:
        raise ParameterError("", "--junit", junit, "given with --require, whose verdicts it writes")
    verdict_file = None if junit is None else junit_file(junit)
    requirements = [parse_requirement(text) for text in require]
    plan = _plan_of(campaign, changes, vary, fields, controller, forces, flights=flights, seed=seed)
    for requirement in requirements:
        parse_event(requirement.event.text, plan.columns)
    if resume and overwrite:
        raise ParameterError("", "--overwrite", overwrite, "absent with --resume")
    if out is None:
        out = Path("runs") / "campaigns" / plan.spec.name
    directory = absolute(out)
    with _watched(directory, progress) as watch:
        result = fly_campaign(
            plan,
            directory,
            workers=workers,
            cluster=cluster,
            resume=resume,
            overwrite=overwrite,
            until_width=until_width,
            report=report,
            watch=watch,
        )
    judgements = tuple(judge(result.table, requirement) for requirement in requirements)
    result = replace(result, judgements=judgements)
    if verdict_file is not None:
        with after(result, verdict_file):
            write_junit(result, verdict_file)
    return result


def _plan_of(
    campaign: CampaignName,
    changes: Changes,
    vary: Variations,
    fields: Fields,
    controller: UserCode,
    forces: UserForces,
    *,
    flights: Whole | None,
    seed: Whole | None,
) -> Plan:
    """Return the plan of a campaign file, or of a scenario with what is drawn for it."""
    from quadsim.features.campaign.plan import load_plan
    from quadsim.scenarios.schema.scenario import Scenario

    if isinstance(campaign, Scenario):
        if changes:
            raise InputError("changes apply to a campaign file; change a scenario by its replace")
        return _scenario_plan(campaign, vary, fields, controller, forces, flights=flights, seed=seed)
    if vary or fields or controller is not None or forces:
        raise InputError("vary, controller, forces and fields apply to a scenario; a campaign file sets them itself")
    return load_plan(str(campaign), list(changes), flights=flights, seed=seed)


def _scenario_plan(
    scenario: Scenario,
    vary: Variations,
    fields: Fields,
    controller: UserCode,
    forces: UserForces,
    *,
    flights: Whole | None,
    seed: Whole | None,
) -> Plan:
    """Return the plan of a scenario given in Python; settings that are None have the defaults of a campaign file."""
    from quadsim.features.campaign.plan import make_plan
    from quadsim.scenarios.user_code import importable

    settings = {"vary": [dict(entry) for entry in vary], "flights": flights, "seed": seed, **(fields or {})}
    stated = {name: value for name, value in settings.items() if value is not None}
    return make_plan(importable(scenario, controller, forces), stated)


def replay(
    campaign: File,
    /,
    *,
    worst: Flag = False,
    flight: Whole | None = None,
    out: File | None = None,
    overwrite: Flag = False,
    video: bool | None = None,
    recording: bool | None = None,
    figures: bool | None = None,
    progress: Watched = True,
    flown: Flown = None,
) -> Replay:
    """Fly one flight of a finished campaign again, with all outputs.

    Args:
        campaign: campaign directory.
        worst: replay the worst flight (the default).
        flight: replay the flight of this number.
        out: run directory (default: runs/CAMPAIGN-N, or the next free name).
        overwrite: replace an earlier output, if its summary.json lists every file in the directory.
        video: film the flight (default: if possible).
        recording: write flight.rrd for the rerun viewer (default: if possible).
        figures: plot the flight (default: if possible).
        progress: as in `fly`.
        flown: as in `run`.

    Returns:
        The flight, and the columns of the campaign's table in which it differs by any bit.

    Raises:
        InputError: the campaign or the flight does not exist.
        OutputError: the directory cannot be written.

    Examples:
        >>> import quadsim
        >>> quadsim.replay("runs/campaigns/not-flown")
        Traceback (most recent call last):
        quadsim.errors.FileError: runs/campaigns/not-flown: is not a campaign: it has no manifest.json
    """
    from quadsim.console.progress import reporting
    from quadsim.features.campaign.campaign import compare_replay, recorded_flight
    from quadsim.interrupts import SignalHold
    from quadsim.outputs import run_directory
    from quadsim.rollout.flown import require_film, write_run
    from quadsim.rollout.rollout import Rollout

    require_film(video)

    if worst and flight is not None:
        raise ParameterError("", "--flight", flight, "absent with --worst")
    recorded = recorded_flight(Path(campaign), flight)
    for note in recorded.notes:
        _log.info(note)
    products = {"video": video, "recording": recording, "figures": figures}
    with run_directory(recorded.scenario.name, out, overwrite=overwrite) as directory, SignalHold():
        with reporting(progress, "the flight") as report:
            again = Rollout(recorded.scenario).fly(report)
        again = write_run(again, directory, products, overwrite=overwrite, progress=progress, flown=flown)
    return compare_replay(again, recorded)


@contextmanager
def _watched(directory: Path, progress: Watched) -> Iterator[Watch]:
    """Yield the function that shows a campaign's progress; Ctrl-C says how to continue."""
    from quadsim.features.campaign.watching import watching

    try:
        with watching(bool(progress)) as watch:
            yield watch
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"{directory} has the flights so far, --resume continues it") from None


def owns(directory: Path) -> bool:
    """Whether a directory is a campaign's."""
    from quadsim.features.campaign.store import is_campaign

    return is_campaign(directory)


def drawn_flights(scenario: Scenario, vary: str | Sequence[Mapping[str, Any]]) -> Plan:
    """Draw a campaign's flights for a scenario that need not be its own; see `quadsim.features.campaign.plan`."""
    from quadsim.features.campaign.plan import plan_for_scenario

    return plan_for_scenario(scenario, vary)


def check_advice(directory: File) -> str:
    """What to do with a campaign instead of `quadsim check`."""
    return (
        f"{directory} is a campaign, not a run: quadsim replay {directory} --worst makes a run of its worst flight; "
        "quadsim campaign --require judges them all"
    )


def compare_directories(
    directories: Sequence[Path],
    out: Path | None = None,
    *,
    overwrite: bool = False,
    names: Sequence[str] = (),
    constraints: ComparedName | None = None,
) -> PairedComparison:
    """Compare two campaigns flight by flight, and write the report if a directory is given.

    With `constraints`, one of the two, both are judged by its tolerances.

    Raises:
        InputError: they are not two finished campaigns, the names are wrong, or `constraints` is none of them or has
            other bounds.
        OutputError: the directory cannot be written.
    """
    from quadsim.console.results import after
    from quadsim.features.campaign.paired import compare_pairs
    from quadsim.features.campaign.plan import plan_differences
    from quadsim.flight.audit import limit_differences
    from quadsim.report.comparison import check_names
    from quadsim.rollout.flight_comparison import place_of

    if len(directories) != 2:
        raise InputError(f"compare takes two campaigns, each by itself, not {len(directories)}")
    check_names(names, 2)
    first = _read_finished(directories[0])
    second = _read_finished(directories[1])
    if names:
        names = (names[0], names[1])
    else:
        names = (first.plan.spec.name, second.plan.spec.name)
    audits: list[str] = []
    if constraints is None:
        audits = limit_differences(first.limits, second.limits)
    else:  # both are judged by the same limits
        limits = (first.limits, second.limits)[place_of(constraints, directories)]
        first = first.judged_by(limits)
        second = second.judged_by(limits)
    comparison = compare_pairs(
        first.table,
        second.table,
        names,
        failures=(first.plan.spec.failure, second.plan.spec.failure),
        differences=plan_differences(first.plan, second.plan),
        audits=audits,
    )
    if out is None:
        return comparison
    with after(comparison, out):
        return replace(comparison, page=comparison.write_report(out, overwrite=overwrite))


class _FinishedCampaign(NamedTuple):
    """A campaign as its directory has it."""

    plan: Plan
    table: pa.Table  # `flights.parquet`
    limits: tuple[Limit, ...]  # of its audit, with both tolerances stated

    def judged_by(self, limits: Sequence[Limit]) -> _FinishedCampaign:
        """The same with the verdicts that other limits give."""
        from quadsim.features.campaign.reaudit import judged_by

        return self._replace(table=judged_by(limits, self.limits, self.table, self.plan.failure))


def _read_finished(directory: Path) -> _FinishedCampaign:
    """Read a campaign directory."""
    from quadsim.features.campaign.store import FLIGHTS_FILE, read_flights, stored_plan

    plan = stored_plan(directory)
    table = read_flights(directory / FLIGHTS_FILE, plan.schema)
    limits = tuple(limit.with_tolerances() for limit in plan.limits)
    return _FinishedCampaign(plan, table, limits)
