"""One rule for margins, tolerances and verdicts, whoever asks."""

from __future__ import annotations

import json
import re
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quadsim
from quadsim import mpc
from quadsim.commands.cli import main
from quadsim.errors import InputError
from quadsim.flight.audit import (
    COMMAND_TOLERANCE,
    UNAUDITED_ADVICE,
    Limit,
    flight_verdict,
    limit_differences,
    worst_finding,
)
from quadsim.flight.rundir import findings_of
from quadsim.rollout.flown import Flight
from quadsim.scenarios.schema.bases import merge
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.scenarios.user_bounds import user_limits

ROOT = Path(__file__).resolve().parents[2]
STATED = {"roll": (-5.0, 5.0), "pitch": (-5.0, 5.0), "speed": (0.0, 250.0), "slew": (-10.0, 5.0)}
ENTRIES = [{"name": name, "signal": name, "lower": low, "upper": high} for name, (low, high) in STATED.items()]


def paper(**changes: Any) -> Scenario:
    return quadsim.load("paper-constrained").replace({"duration": 12.0, "constraints": [], **changes})


@cache
def paper_flight(entries: str) -> Flight:
    """It is audited by no entry, by `stated` ones, or by `strict` ones, without tolerance."""
    strict = [{**entry, "tolerance": 0.0} for entry in ENTRIES]
    return quadsim.fly(paper(constraints={"none": [], "stated": ENTRIES, "strict": strict}[entries]))


def test_a_bound_has_the_same_verdict_whether_the_controller_or_an_entry_states_it() -> None:
    derived = paper_flight("none")
    stated = paper_flight("stated")
    assert (derived.command == stated.command).all()
    assert [finding.limit.tolerances for finding in derived.audit] == [f.limit.tolerances for f in stated.audit]
    assert derived.outcome == stated.outcome == "satisfied"
    assert not limit_differences(derived.assembly.limits, stated.assembly.limits)
    pitch = next(finding for finding in stated.audit if finding.limit.name == "pitch")
    assert -pitch.limit.tolerances[0] < pitch.margin < 0.0, "or the flight shows nothing"


@pytest.mark.parametrize(
    ("signal", "bounds", "stated", "expected"),
    [
        ("roll", (-5.0, 5.0), {}, (0.05, 0.01)),
        ("roll", (-5.0, 5.0), {"tolerance": 0.2}, (0.2, 0.04)),
        ("roll", (-5.0, 5.0), {"tolerance": 0.2, "tolerance_sampled": 0.0}, (0.2, 0.0)),
        ("roll", (-5.0, 5.0), {"tolerance_sampled": 0.3}, (0.3, 0.3)),
        ("z", (0.2, np.inf), {}, (0.002, 0.0004)),
        ("x_error", (-0.1, 0.1), {}, (0.001, 0.001)),
        ("x_error", (-0.1, 0.1), {"tolerance": 0.01}, (0.01, 0.01)),
        ("speed", (0.0, 250.0), {}, (1e-6, 1e-6)),
        ("slew", (-10.0, 5.0), {"tolerance": 0.1}, (0.1, 0.1)),
    ],
)
def test_tolerances_default_by_signal_and_a_stated_one_sets_the_other_in_proportion(
    signal: str, bounds: tuple[float, float], stated: dict[str, float], expected: tuple[float, float]
) -> None:
    limit = Limit(name="a", signal=signal, lower=bounds[0], upper=bounds[1], **stated)
    assert limit.tolerances == pytest.approx(expected)
    assert limit.with_tolerances().tolerances == pytest.approx(expected)


def test_a_sum_of_rotor_speeds_is_a_command_and_any_other_sum_is_not() -> None:
    speeds = Limit(name="a", signal="sum", terms={"speed_1": 1.0, "speed_3": -1.0}, upper=20.0)
    mixed = Limit(name="b", signal="sum", terms={"speed_1": 1.0, "x": 5.0}, upper=20.0)
    assert (speeds.source.tolerance, mixed.tolerances) == (COMMAND_TOLERANCE, pytest.approx((0.2, 0.04)))


def test_a_bases_tolerance_survives_only_in_an_entry_that_states_neither_bounds_nor_tolerances() -> None:
    base = {"constraints": [{"name": "a", "signal": "roll", "lower": -5, "tolerance": 0.3, "tolerance_sampled": 0.2}]}

    def over(**entry: Any) -> dict[str, Any]:
        (merged,) = merge(base, {"constraints": [{"name": "a", **entry}]})["constraints"]
        return {key: value for key, value in merged.items() if "tolerance" in key}

    assert over(required=False) == {"tolerance": 0.3, "tolerance_sampled": 0.2}
    assert over(lower=-4.0) == over(upper=4.0) == {}
    assert over(tolerance=0.1) == {"tolerance": 0.1}


def test_no_other_module_compares_a_margin_with_a_tolerance() -> None:
    """In Python: `margin < -tolerance` and its like have one owner."""
    pattern = re.compile(r"[<>]=?\s*-\s*(\w+\.)*tolerance|\.tolerance(_sampled)?\s*[<>]|\+\s*(\w+\.)*tolerance")
    files = [path for folder in ("quadsim", "docs", "benchmarks") for path in (ROOT / folder).rglob("*.py")]
    offenders = {
        str(path.relative_to(ROOT))
        for path in files
        if "identify" not in path.parts and pattern.search(path.read_text(encoding="utf-8"))
    }
    assert offenders == {"quadsim/flight/audit.py"}


def test_the_worst_finding_is_the_smallest_share_of_the_band_with_ties_by_declaration() -> None:
    flight = paper_flight("none")
    by_name = {finding.limit.name: finding for finding in flight.audit}
    assert worst_finding(flight.audit) is by_name["pitch"]
    assert by_name["pitch"].share == pytest.approx(by_name["pitch"].margin / 5.0)
    twins = [by_name["roll"], by_name["roll"].__class__(**{**vars(by_name["roll"]), "limit": by_name["pitch"].limit})]
    worst = worst_finding(twins)
    assert worst is not None
    assert worst.limit.name == "roll", "of equals the first in the file"
    assert worst_finding([]) is None
    assert worst_finding([by_name["speed"], by_name["slew"]]) is None, "a command at its own bound is no near miss"


def test_every_form_of_an_ending_has_its_verdict() -> None:
    def verdict(**how: bool) -> str:
        return flight_verdict((), **{"aborted": False, "lost": False, "failed": False} | how)

    assert verdict() == "unaudited"
    assert verdict(failed=True) == "violated"
    assert verdict(failed=True, lost=True) == "lost"
    assert verdict(lost=True, aborted=True) == "aborted"


# --- unaudited -------------------------------------------------------------------------------------------------------

UNBOUNDED = {"controller": {"type": "lqr"}, "constraints": [], "duration": 0.5}


def test_a_flight_without_constraints_is_unaudited_run_passes_and_check_fails(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = ["--set", "controller=lqr", "--set", "constraints=[]", "--set", "duration=0.5"]
    run = tmp_path / "run"
    assert main(["run", "hover", *settings, "--out", str(run), "--no-video", "--no-recording", "--no-figures"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert UNAUDITED_ADVICE in shown
    junit = tmp_path / "junit.xml"
    assert main(["check", str(run), "--junit", str(junit)]) == 1
    assert main(["check", "hover", *settings]) == 1
    shown = " ".join(capsys.readouterr().out.split())
    assert shown.count(UNAUDITED_ADVICE) == 2
    assert 'failures="1"' in junit.read_text(encoding="utf-8")
    summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    assert (summary["verdict"], summary["satisfied"], findings_of(summary)) == ("unaudited", False, ())


def test_an_unaudited_campaign_supports_no_requirement_on_violations(tmp_path: Path) -> None:
    mass = {"name": "m", "fields": ["actual.mass"], "distribution": "uniform", "low": 3.9, "high": 4.1}
    requirements = ["P(violation) < 0.5 @ 95%", "P(lost) < 0.9 @ 95%"]
    result = quadsim.campaign(
        quadsim.load("hover").replace(UNBOUNDED),
        vary=[mass],
        flights=5,
        fields={"failure": ["violated"]},
        require=requirements,
        workers=1,
        out=tmp_path / "campaign",
    )
    violation, lost = result.judgements
    assert (violation.holds, violation.flights, violation.unaudited, lost.holds, lost.flights) == (False, 0, 5, True, 5)
    assert UNAUDITED_ADVICE in violation.sentence
    assert result.exit_status == 1
    assert result.summary["verdicts"]["unaudited"] == 5


# --- a user's own controller -----------------------------------------------------------------------------------------


class Bounded:
    """Hovers, and says what bounds it means to keep."""

    def __init__(self, vehicle: quadsim.Vehicle, *, kind: str = "bounds", **_: Any) -> None:
        self.speeds = np.full(4, vehicle.hover_speed)
        if kind == "bounds":
            self.bounds = {"roll": (-3.0, 3.0), "speed": (0.0, 230.0)}
        elif kind == "constraints":
            self.constraints = [{"name": "fence", "signal": "x", "upper": 2.0}]
        elif kind == "problem":
            self.problem = quadsim.problem("paper-constrained")
        elif kind == "junk":
            self.bounds = {"roll": "wide"}
            self.constraints = [7]

    def step(self, *_: Any) -> np.ndarray[Any, np.dtype[np.float64]]:
        return self.speeds


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("bounds", {"roll": (-3.0, 3.0), "speed": (0.0, 230.0)}),
        ("constraints", {"fence": (-np.inf, 2.0)}),
        ("problem", STATED),
        ("junk", {}),
    ],
)
def test_a_users_controller_is_audited_against_its_own_bounds(
    kind: str, expected: dict[str, Any], tmp_path: Path
) -> None:
    flight = quadsim.fly(quadsim.load("hover").replace(UNBOUNDED), controller=partial(Bounded, kind=kind))
    limits = {finding.limit.name: (finding.limit.lower, finding.limit.upper) for finding in flight.audit}
    assert limits.keys() == expected.keys()
    for name, bounds in expected.items():
        assert limits[name] == pytest.approx(bounds)
    assert flight.outcome == ("satisfied" if expected else "unaudited")
    read = quadsim.read(flight.save(tmp_path / "run", video=False, recording=False, figures=False))
    assert [finding.limit for finding in read.audit] == [finding.limit for finding in flight.audit]


def test_an_entry_of_the_scenario_takes_precedence_over_the_controllers_bounds() -> None:
    entry = {"name": "mine", "signal": "roll", "lower": -1.0, "upper": 1.0}
    scenario = quadsim.load("hover").replace({**UNBOUNDED, "constraints": [entry]})
    flight = quadsim.fly(scenario, controller=Bounded)
    assert [finding.limit.name for finding in flight.audit] == ["mine", "speed"]


def test_rows_that_combine_states_become_sums() -> None:
    C = np.zeros((2, 12))
    C[0, 0] = 1.0
    C[0, 1] = 0.5
    C[1, 6] = -2.0
    row = mpc.Constraint(name="near", lower=np.array([-np.inf, -0.2]), upper=np.array([3.0, 0.4]), C=C)
    near, roll = user_limits(type("Law", (), {"constraints": [row]})())
    assert (near.name, near.signal, near.terms, near.upper) == ("near_1", "sum", {"x": 1.0, "vx": 0.5}, 3.0)
    assert (roll.signal, roll.lower, roll.upper) == (
        "roll",
        pytest.approx(np.degrees(-0.2)),
        pytest.approx(np.degrees(0.1)),
    )


# --- comparisons -----------------------------------------------------------------------------------------------------


def test_flights_that_are_audited_differently_are_compared_by_margins_until_audited_alike() -> None:
    a = paper_flight("stated")
    b = paper_flight("strict")
    assert (a.outcome, b.outcome) == ("satisfied", "violated")
    different = quadsim.compare(a, b)
    first = different.text().splitlines()[0]
    assert "roll: tolerances 0.05 / 0.01 and 0 / 0" in first
    alike = quadsim.compare(a, b, constraints=a)
    outcomes = next(row for row in alike.to_json() if row["label"] == "outcome")
    assert set(outcomes["values"].values()) == {"satisfied"}
    assert not quadsim.compare(a, a).notes
    with pytest.raises(InputError, match="--constraints"):
        quadsim.compare(a, b, constraints="elsewhere")


@pytest.mark.slow("campaigns")
def test_campaigns_that_are_audited_differently_get_no_test_of_violations(tmp_path: Path) -> None:
    mass = {"name": "m", "fields": ["actual.mass"], "distribution": "uniform", "low": 3.9, "high": 4.1}

    def flown(name: str, constraints: list[dict[str, Any]]) -> Path:
        out = tmp_path / name
        quadsim.campaign(paper(constraints=constraints), vary=[mass], flights=4, workers=1, out=out)
        return out

    lenient = flown("lenient", ENTRIES)
    strict = flown("strict", [{**entry, "tolerance": 0.0} for entry in ENTRIES])
    compared = quadsim.compare(lenient, strict)
    assert compared.verdict == "not comparable"
    assert {"failure", "violation"}.isdisjoint(event.event for event in compared.events)
    assert compared.text().startswith("Audited differently:")
    assert "worst_margin" in {metric.name for metric in compared.metrics}
    alike = quadsim.compare(lenient, strict, constraints=lenient)
    assert alike.verdict == "not distinguishable"
    (failure, *_) = alike.events
    assert (failure.event, failure.only_a, failure.only_b) == ("failure", 0, 0)
    other = flown("other", [{**entry, "upper": 300.0} if entry["name"] == "speed" else entry for entry in ENTRIES])
    with pytest.raises(InputError, match="speed: upper 250 and 300"):
        quadsim.compare(lenient, other, constraints=lenient)
