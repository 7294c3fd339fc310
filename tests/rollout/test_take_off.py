"""Take-off of a vehicle that is heavier than its model, by every law of the library; and the verdict without one."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quadsim
from quadsim.commands.cli import main
from quadsim.console.results import EXIT_FAILED
from quadsim.controller import Phase
from quadsim.flight.metrics import never_took_off
from quadsim.flight.phase import AIRBORNE, LARGEST_LEAD
from quadsim.rollout.reaudit import reaudit
from quadsim.sim.loop import TAKEOFF_LEAD
from quadsim.state import INDEX

pytestmark = pytest.mark.slow("take-off")

Fields = Mapping[str, Any]
PILOTED: Fields = {"autopilot": {}, "plant.limit_speeds": True}
LAWS: dict[str, tuple[str, Fields]] = {
    "unconstrained": ("paper-unconstrained-clipped", {}),
    "constrained": ("paper-constrained", {}),
    "robust": ("robust", {}),
    "robust-lag": ("robust", {"controller.rotor_lag": 0.05, "effects.rotors": {"rise": 0.05}}),
    "robust-piqp": ("robust", {"controller.solver": "piqp"}),
    "nonlinear": ("nonlinear", {}),
    "nonlinear-observer": ("nonlinear", {"controller.offset_free": {}}),
    "nonlinear-disturbance": ("nonlinear", {"controller.disturbance": {}}),
    "nonlinear-rates": (
        "hover",
        {"controller": {"type": "nonlinear", "commands": "rates", "terminal": "lqr"}, **PILOTED},
    ),
    "lqr": ("hover", {"controller": {"type": "lqr"}}),
    "pid": ("hover", {"controller": {"type": "pid"}}),
    "geometric": ("hover", {"controller": {"type": "geometric"}}),
    "geometric-integral": ("hover", {"controller": {"type": "geometric", "integral": True}}),
    "geometric-disturbance": ("hover", {"controller": {"type": "geometric", "disturbance": {}}}),
    "geometric-indi": ("hover", {"controller": {"type": "geometric", "indi": {}}}),
    "geometric-rates": ("hover", {"controller": {"type": "geometric", "commands": "rates"}, **PILOTED}),
    "geometric-attitude": ("hover", {"controller": {"type": "geometric", "commands": "attitude"}, **PILOTED}),
}
EACH_KIND = ("constrained", "robust", "nonlinear", "pid", "geometric-attitude")
MASS = 4.0  # of the paper's vehicle, as modelled [kg]
TOLD = 1.0  # the last control instant before the course rises [s]
QUIET = ("--no-video", "--no-recording", "--no-figures")


def from_the_ground(law: str, height: float, heavier: float, **others: Any) -> quadsim.Scenario:
    """A step from cold rotors on the ground to a height [m], by a vehicle heavier by a share."""
    base, fields = LAWS[law]
    ground: Fields = {
        "duration": 20.0,
        "constraints": (),
        "initial.position": [0.0, 0.0, 0.0],
        "initial.cold": True,
        "effects.ground": {},
        "actual.mass": MASS * (1.0 + heavier),
        "reference": {"type": "steps", "z": [{"start": TOLD, "stop": 100.0, "value": height}]},
        "expect": "satisfied",
    }
    return quadsim.load(base).replace({**ground, **fields, **others})


@pytest.mark.parametrize(
    ("law", "height", "heavier"),
    [
        *(pytest.param(law, 0.3, 0.3, marks=pytest.mark.representative("take-off")) for law in EACH_KIND),
        *((law, 0.3, 0.3) for law in LAWS if law not in EACH_KIND),
        *((law, height, 0.3) for law in LAWS for height in (0.5, 1.5, 5.0)),
        *((law, 0.3, heavier) for law in LAWS for heavier in (0.0, 0.04, 0.11)),
    ],
)
def test_every_law_takes_off(law: str, height: float, heavier: float) -> None:
    """Within its bounds; with the right model without help, the heaviest within 8 s of being told."""
    with quadsim.start(from_the_ground(law, height, heavier)) as flight:
        while flight.loop.last is None or flight.loop.last.phase is not Phase.FLYING:
            flight.step()
            assert flight.loop.time < TOLD + 8.0, "it is still on the ground"
        flown = flight.flight()
    assert all(finding.satisfied for finding in flown.findings if finding.limit.signal in ("speed", "slew"))
    assert (TAKEOFF_LEAD in flown.logged) <= (heavier > 0.0)


def lead_of(flight: quadsim.Flight) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.nan_to_num(flight.logged[TAKEOFF_LEAD])


@pytest.mark.parametrize("law", ["robust", "pid"])
def test_a_law_that_learns_takes_over_from_the_lead(law: str) -> None:
    """The lead falls from lift-off on, the vehicle never sinks back, and no error is left."""
    flight = quadsim.fly(from_the_ground(law, 0.3, 0.3))
    lead = lead_of(flight)
    z = flight.state["z"]
    airborne = int(np.flatnonzero(z > AIRBORNE)[0])
    assert lead[airborne - 1] > 0.5
    assert (np.diff(lead[airborne:]) <= 0.0).all()
    assert lead[-1] < 0.01
    assert z[airborne:].min() > AIRBORNE
    assert z.max() < 0.6
    assert z[-1] == pytest.approx(0.3, abs=0.02)
    steps = np.abs(np.diff(np.square(flight.command).sum(axis=1)))[airborne:]
    assert steps.max() < 0.03 * np.square(flight.command[airborne]).sum()  # no jump of the thrust


@pytest.mark.parametrize("law", ["unconstrained", "constrained", "lqr", "geometric"])
def test_a_law_without_an_integral_hovers_above_the_ground(law: str) -> None:
    """With 30 % more weight these would hover more than 0.3 m below their target, in the ground."""
    flight = quadsim.fly(from_the_ground(law, 0.3, 0.3))
    assert flight.state["z"][-20:].min() > 0.01
    assert flight.state["z"][-1] < 0.3
    assert never_took_off(flight.log.control) is None
    assert flight.outcome == ("satisfied" if law == "constrained" else "unaudited")  # the others state no bounds


def test_rotors_that_saturate_stop_the_lead() -> None:
    """What is too heavy to fly is pushed no further than its rotors follow; without its load it does not shoot up."""
    load = {"effects.load": {"payloads": [{"mass": 4.0, "position": [0.0, 0.0, 0.0]}]}}
    dropped = {"events": [{"type": "payload_drop", "at": 12.0}]}
    flight = quadsim.fly(from_the_ground("robust", 0.3, 0.0, **load, **dropped))
    lead = lead_of(flight)
    z = flight.state["z"]
    assert z[flight.time < 12.0].max() < AIRBORNE
    assert lead.max() < LARGEST_LEAD
    assert z.max() < 6.0  # with 1.8 times its weight in thrust when the load goes
    assert z[-1] == pytest.approx(0.3, abs=0.1)


def test_it_takes_off_again_after_a_landing() -> None:
    course = [{"start": 1.0, "stop": 10.0, "value": 0.5}, {"start": 10.0, "stop": 14.0, "value": -0.3}]
    course.append({"start": 14.0, "stop": 100.0, "value": 0.5})
    fields = {"duration": 24.0, "reference": {"type": "steps", "z": course}}
    flight = quadsim.fly(from_the_ground("robust", 0.5, 0.11, **fields))
    phases = [
        phase for k, phase in enumerate(flight.log.control.phase) if k == 0 or phase != flight.log.control.phase[k - 1]
    ]
    assert phases == ["armed", "flying", "landed", "armed", "flying"]
    assert flight.state["z"][-1] == pytest.approx(0.5, abs=0.1)


def test_it_takes_off_from_a_tilted_start() -> None:
    tilted = {"initial.position": [0.0, 0.0, 0.04], "initial.euler": [6.0, 0.0, 0.0]}
    flight = quadsim.fly(from_the_ground("robust", 0.5, 0.3, **tilted))
    assert never_took_off(flight.log.control) is None
    assert flight.state["z"][-1] == pytest.approx(0.5, abs=0.1)


def test_a_flight_that_never_leaves_the_ground_is_violated_and_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Worn rotors that give less than the weight, whatever every constraint says."""
    worn = {"effects.rotors": {"efficiency": [0.5] * 4}}
    scenario = from_the_ground("robust", 0.5, 0.0, duration=10.0, **worn)
    flight = quadsim.fly(scenario)
    assert flight.outcome == "violated"
    assert all(finding.satisfied for finding in flight.findings)
    flight.save(tmp_path / "run")
    again = quadsim.read(tmp_path / "run")
    assert (again.outcome, never_took_off(again.log.control)) == ("violated", TOLD + 0.05)
    assert not reaudit(tmp_path / "run").satisfied
    assert main(["check", str(tmp_path / "run")]) == EXIT_FAILED
    printed = " ".join(capsys.readouterr().out.split())
    assert "t = 1.05 s" in printed
    assert quadsim.fly(scenario.replace({"duration": 3.5})).outcome == "satisfied"  # too short to tell
    assert flight.state["z"].max() < AIRBORNE + flight.log.plant.state[:, INDEX["z"]].min()
