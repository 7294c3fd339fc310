"""A law whose model is wrong is told which state it gets wrong first, and a law whose model is right is not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import NO_PRODUCTS

import quadsim
from quadsim import mpc
from quadsim.console.summary_tables import summary_tables
from quadsim.rollout.flown import Flight
from quadsim.rollout.stored import read_flight
from quadsim.state import INDEX, Array

ALONG_Y = ("y", "vy")
ABOUT_Z = ("yaw", "yaw_rate")


class Reversed:
    """A linear MPC whose model has the effect of attitude and rotors on some states with the wrong sign."""

    name = "mine"
    solver = "piqp-multistage"

    def __init__(self, vehicle: quadsim.Vehicle, period: float, horizon: int, states: tuple[str, ...] = ()) -> None:
        model = mpc.hover_model(vehicle, period)
        A = model.A.copy()
        B = model.B.copy()
        rows = [INDEX[name] for name in states]
        for name in ("roll", "roll_rate"):
            A[rows, INDEX[name]] *= -1.0
        B[rows] *= -1.0
        self.problem = mpc.Problem(
            horizon=horizon,
            model=replace(model, A=A, B=B),
            objective=mpc.Objective(
                C_r=np.eye(12)[[0, 2, 4, 10]], Q_y=np.diag([10.0, 10.0, 100.0, 100.0]), Q_u=9e-4 * np.eye(4)
            ),
            bounds=mpc.Bounds(
                C_c=np.eye(12)[[6, 8]],
                y_min=-np.radians([30.0, 30.0]),
                y_max=np.radians([30.0, 30.0]),
                delta_min=np.full(4, -150.0),
                delta_max=np.full(4, 150.0),
                u_min=np.zeros(4),
                u_max=np.full(4, 838.0),
            ),
        )
        self._qp = mpc.QPSolver(self.solver, self.problem)

    def reset(self, speeds: Array) -> None:
        self.before = speeds

    def step(self, now: quadsim.StepInputs, state: Array, reference: Array) -> Array:
        query = mpc.Query(np.array(state), self.problem.objective.desired(reference), self.before)
        answer = self._qp.solve(query)
        if answer.status == "solved":
            self.before = np.clip(answer.plan[0], 0.0, 838.0)
        return self.before


class Predicting(Reversed):
    """The same; it says what it predicts."""

    def predict(self, states: Array, plans: Array) -> Array:
        model = self.problem.model
        predicted = np.empty((*plans.shape[:2], 12))
        for i in range(plans.shape[1]):
            states = states @ model.A.T + (plans[:, i] - model.u_bar) @ model.B.T
            predicted[:, i] = states
        return predicted


def flown(law: type[Reversed], states: tuple[str, ...] = (), **changes: Any) -> Flight:
    """The figure eight of a Hummingbird, at first, and what the law makes of it."""
    settings = {"duration": 4.0, "constraints": [], "controller.horizon": 20} | changes
    scenario = quadsim.load("hummingbird-figure-eight").replace(settings)
    controller = law(quadsim.load_vehicle("hummingbird"), scenario.control_period, 20, states)
    return quadsim.fly(scenario, controller=controller, progress=False)


def sentences(flight: Flight) -> list[str]:
    return [text for text in summary_tables(flight) if isinstance(text, str) and "the wrong way" in text]


@pytest.mark.parametrize("law", [Reversed, Predicting])
def test_a_side_force_with_the_wrong_sign_is_named_whether_the_law_predicts_or_has_a_problem(
    law: type[Reversed], tmp_path: Path
) -> None:
    flight = flown(law, ALONG_Y)
    assert flight.outcome == "lost"
    first = flight.numbers["model_error"]["states"][0]
    assert first["state"] == "vy"
    assert first["predicted"] * first["flown"] < 0.0
    assert first["predicted"] == pytest.approx(-first["flown"], rel=0.2)
    (sentence,) = sentences(flight)
    assert sentence.startswith(f"your model moves the wrong way along y: in the period from {first['time']:.4g} s")
    assert sentence.endswith(" m/s")
    read = read_flight(flight.save(tmp_path / "run", **NO_PRODUCTS))
    assert sentences(read) == [sentence]


def test_a_yaw_torque_with_the_wrong_sign_is_named_for_a_law_that_ships_too() -> None:
    spins = quadsim.load_vehicle("hummingbird").rotor_spins
    scenario = quadsim.load("hummingbird-figure-eight").replace(
        {
            "duration": 3.0,
            "constraints": [],
            "reference.yaw_along_path": True,
            "actual": {"rotor_spins": [-spin for spin in spins]},
        }
    )
    flight = quadsim.fly(scenario, progress=False)
    assert flight.numbers["model_error"]["states"][0]["state"] == "yaw_rate"
    (sentence,) = sentences(flight)
    assert sentence.startswith("the model of constrained turns the wrong way about z: ")
    assert sentence.endswith(" deg/s")


NOISE = {name: {"rate": 200.0, "noise": noise} for name, noise in (("position", 0.002), ("attitude", 0.2))}
QUIET: dict[str, dict[str, Any]] = {
    "as modelled": {},
    "wind": {"effects.air": {"wind": [3.0, 2.0, 0.0]}},
    "pushes": {"events": [{"type": "push", "at": 1.0, "duration": 0.1, "force": [3.0, -3.0, 2.0]}]},
    "worn rotor": {"events": [{"type": "rotor_loss", "at": 1.0, "rotor": 1, "loss": 0.1}]},
    "heavier": {"effects.load": {"mass_factor": 1.3}},
    "noise": {"sensors": NOISE},
}


@pytest.mark.parametrize(("law", "what"), [(Reversed, "as modelled"), *((Predicting, what) for what in QUIET)])
def test_a_right_model_is_not_blamed_for_what_it_does_not_know(law: type[Reversed], what: str) -> None:
    flight = flown(law, **QUIET[what])
    assert flight.log.foreseen is not None
    assert flight.log.foreseen.shape == (80, 12)
    assert "model_error" not in flight.numbers
    assert sentences(flight) == []


def test_a_law_without_a_model_says_nothing_of_it() -> None:
    scenario = quadsim.load("hover").replace({"duration": 1.0, "constraints": []})
    flight = quadsim.fly(scenario, controller=lambda now, state, reference: [200.0] * 4, progress=False)
    assert flight.log.foreseen is None
    assert "model_error" not in flight.numbers
