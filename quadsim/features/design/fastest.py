"""The fastest speed at which a scenario's course is flown within every bound, by bisection of audited flights.

At pace p every time of the course, of its filter, of moving obstacles and of windows is 1 / p of what is stated;
lengths and bounds stay.  A pace holds if the flight is satisfied and every required margin is at least a share of half
its band (`quadsim.flight.audit.worst_share`); limits of the commands only have to hold: a command at its own bound is
normal.  The result has a pace that holds and one at most `_RESOLUTION` faster that does not; both were flown.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import tomlkit
from tomlkit.items import AoT

from quadsim.console.progress import Progress, silent
from quadsim.errors import InputError, ParameterError, printable
from quadsim.features.design.courses_by_rule import SHARE
from quadsim.features.design.first_scenario import FirstScenario
from quadsim.flight.audit import Finding, Limit, worst_finding
from quadsim.rollout.flown import Flight
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.preflight import checked
from quadsim.scenarios.scaling import Scale, scaled_limit, scaled_table
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.scenarios.schema.writing import LINE_WIDTH, plain

DEFAULT_MARGIN: Final = 0.1  # default share of half a band that is left
LARGEST_MARGIN: Final = 0.9
_STEP: Final = 1.3  # from one pace to the next, until one holds and one does not
_LOWEST = 0.05
_HIGHEST = 50.0
"""Range of the paces that are tried."""
_RESOLUTION: Final = 0.01  # between the pace that holds and the one that does not, as a share
_USUAL_FLIGHTS: Final = 9  # total shown as progress; the true number is not known before the end


@dataclass(frozen=True, kw_only=True)
class PacedFlight:
    """A flight at a pace."""

    pace: float  # times the stated speed
    speed: float  # largest of the filtered course [m/s]
    outcome: str  # its verdict
    worst: Finding | None  # the nearest bound; None where nothing was audited
    holds: bool  # whether every bound holds with the margin

    @property
    def text(self) -> str:
        """Its nearest bound, and its verdict if that is not `satisfied`."""
        if self.worst is None:
            return self.outcome
        nearest = f"{self.worst.limit.name} has {100.0 * self.worst.share:.3g} % of half its band left"
        if self.outcome == "satisfied":
            return nearest
        return f"{nearest}; {self.outcome}"


@dataclass(frozen=True, kw_only=True)
class FastestCourse:
    """The fastest pace that holds, and the next that does not."""

    scenario: Scenario  # at the fastest pace
    margin: float  # share of half of each band that was required
    fastest: PacedFlight  # holds
    stopped: PacedFlight  # does not
    flights: tuple[PacedFlight, ...]  # all of them, in the order in which they were flown

    @property
    def lines(self) -> tuple[str, ...]:
        """Sentences for the head of its file."""
        return (
            f"Fastest: {self.fastest.speed:.4g} m/s, {self.fastest.pace:.4g} times the speed by rule. With "
            f"{100.0 * self.margin:g} % required, {self.fastest.text}.",
            f"At {self.stopped.speed:.4g} m/s, {self.stopped.text}. "
            f"Bisection of {len(self.flights)} audited flights, with the vehicle's lag and drag.",
        )


def paced(scenario: Scenario, pace: float) -> Scenario:
    """Return a scenario whose course, with its windows and moving obstacles, is flown at a pace.

    Raises:
        ScenarioError: it is not allowed at this pace.
    """
    scale = Scale(time=1.0 / pace)
    tables = scenario.tables
    tables["reference"] = plain(scaled_table(scenario.reference, scale))
    for name in ("obstacles", "corridors"):
        shapes = getattr(scenario, name)
        if shapes:
            tables[name] = [plain(scaled_table(shape, scale)) for shape in shapes]
    if scenario.constraints:
        retimed = []
        for entry, limit in zip(tables["constraints"], scenario.constraints, strict=True):
            retimed.append(_retimed(entry, limit, scale))
        tables["constraints"] = retimed
    if not scenario.ends_with_course:
        periods = math.ceil(scenario.duration / pace / scenario.control_period - 1e-6)
        tables["duration"] = round(periods * scenario.control_period, 9)
    return scenario.derive(tables)


def _retimed(entry: dict[str, Any], limit: Limit, scale: Scale) -> dict[str, Any]:
    """Return an entry of `[[constraints]]` with its window at another pace; its bounds stay."""
    unbounded = replace(limit, lower=-math.inf, upper=math.inf)
    timed = scaled_limit(unbounded, scale)
    retimed = dict(entry)
    if "start" in entry:
        retimed["start"] = timed.start
    if "stop" in entry:
        retimed["stop"] = timed.stop
    return retimed


def fly_fastest(scenario: Scenario, margin: float = DEFAULT_MARGIN, progress: Progress = silent) -> FastestCourse:
    """Return the fastest pace at which every bound holds with a margin.

    Args:
        scenario: whose course is flown faster and slower.
        margin: share of half of each band that has to be left, 0 to `LARGEST_MARGIN`.
        progress: called with (activity, done, total) after each flight.

    Raises:
        ParameterError: the margin is out of range.
        InputError: the course does not move, no pace holds, or none fails.
    """
    if not 0.0 <= margin <= LARGEST_MARGIN:
        raise ParameterError("", "--margin", margin, f"between 0 and {LARGEST_MARGIN:g}, a share of half of each band")
    flights: list[PacedFlight] = []

    def fly(pace: float) -> PacedFlight:
        total = max(_USUAL_FLIGHTS, len(flights) + 1)
        progress(f"flight {len(flights) + 1}", len(flights), total)
        flight = _fly_at(scenario, pace, margin)
        flights.append(flight)
        return flight

    holds, fails = _bracket(fly)
    while fails.pace / holds.pace > 1.0 + _RESOLUTION:
        middle = fly(math.sqrt(holds.pace * fails.pace))
        if middle.holds:
            holds = middle
        else:
            fails = middle
    at_fastest = paced(scenario, holds.pace)
    return FastestCourse(scenario=at_fastest, margin=margin, fastest=holds, stopped=fails, flights=tuple(flights))


def at_fastest(first: FirstScenario, fastest: FastestCourse) -> FirstScenario:
    """Return a first scenario at the fastest pace that holds, with a comment at each number that it changes."""
    document = tomlkit.parse(first.text)
    _restate(document, paced(first.scenario, 1.0).tables, fastest.scenario.tables)
    subject, _, _ = first.scenario.description.partition(f" at {100.0 * SHARE:g} % of ")
    description = f"{subject}, as fast as its bounds permit"
    document["description"] = description
    _, made_by, rest = document.as_string().split("\n", 2)
    head = f"# A first flight of {printable(description)}.\n{made_by} --fastest --margin {fastest.margin:g}\n"
    for sentence in fastest.lines:
        for line in textwrap.wrap(sentence, LINE_WIDTH - 2):
            head += f"# {line}\n"
    return replace(first, text=head + rest)


def _restate(stated: Any, before: Mapping[str, Any], after: Mapping[str, Any]) -> None:
    """Change the numbers of a document that differ between two tables to those of the second, in place."""
    for key, value in after.items():
        earlier = before.get(key)
        if value == earlier:
            continue
        if isinstance(value, dict):
            _restate(stated[key], earlier or {}, value)
        elif isinstance(stated.get(key), AoT):
            for entry, entry_before, entry_after in zip(stated[key], earlier or value, value, strict=True):
                _restate(entry, entry_before, entry_after)
        else:
            item = tomlkit.item(value)
            item.comment("at the fastest pace")
            item.trivia.comment_ws = "  "
            stated[key] = item


def _bracket(fly: Callable[[float], PacedFlight]) -> tuple[PacedFlight, PacedFlight]:
    """Return flights at a pace that holds and at one `_STEP` faster that does not, from the stated speed on."""
    flight = fly(1.0)
    if not flight.speed > 0.0:
        raise InputError("--fastest needs a course that moves")
    if flight.holds:
        while flight.holds:
            holds = flight
            if holds.pace * _STEP > _HIGHEST:
                raise InputError(
                    f"every bound holds at {holds.pace:.3g} times the speed by rule: nothing stops the course"
                )
            flight = fly(holds.pace * _STEP)
        return holds, flight
    while not flight.holds:
        fails = flight
        if fails.pace / _STEP < _LOWEST:
            raise InputError(f"no speed holds: at {fails.speed:.3g} m/s, {fails.text}")
        flight = fly(fails.pace / _STEP)
    return flight, fails


def _fly_at(scenario: Scenario, pace: float, margin: float) -> PacedFlight:
    """Return the flight at a pace."""
    assembly = checked(Assembly(paced(scenario, pace)))
    reference = assembly.reference(assembly.scenario.periods + 1)
    steps = np.linalg.norm(np.diff(reference[:, :3], axis=0), axis=1)
    flight: Flight = Rollout(assembly).fly()
    worst = worst_finding(flight.findings)
    has_margin = worst is None or margin == 0.0 or worst.share >= margin
    return PacedFlight(
        pace=pace,
        speed=float(steps.max()) / assembly.scenario.control_period,
        outcome=flight.outcome,
        worst=worst,
        holds=flight.outcome == "satisfied" and has_margin,
    )
