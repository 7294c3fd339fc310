"""The figures of the guides, each from flights of its own: part of `make numbers OPTIONS=pictures`, or some by name."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from runpy import run_path
from typing import Any, Final

import figures
import numpy as np

import quadsim
import quadsim.gym
from quadsim.flight.audit import SIGNALS
from quadsim.palette import COLOUR, CYCLE
from quadsim.report.figure import Area, Bound, Figure, Panel, Series, outlines
from quadsim.report.flight_figures import signals
from quadsim.report.vehicle_drawing import vehicle_figure
from quadsim.sim.effects.battery import LIPO
from quadsim.state import POSITION
from scenarios.identify.identification_figures import trace_figure

ROOT: Final = Path(__file__).resolve().parents[2]
FREE: Final[dict[str, Any]] = {"constraints": []}
NEAR: Final = 1.2  # of a pillar, where half-spaces are drawn [m]


def curves(
    name: str,
    flights: Mapping[str, quadsim.Flight],
    title: str = "",
    *,
    bounds: Sequence[float] = (),
    start: float = 0.0,
) -> Panel:
    """A signal of several flights from `start` on, at the physics rate."""
    signal = SIGNALS[name]
    assert signal.plant is not None
    lines = [
        Series(x=flight.log.plant.t, y=signal.plant(flight.log.plant), colour=CYCLE[i], label=label)
        for i, (label, flight) in enumerate(flights.items())
    ]
    limits = tuple(Bound(value=value) for value in bounds)
    axis = f"{name} [{signal.unit}]" if title else ""
    return Panel(
        title=title or name,
        unit="" if title else signal.unit,
        y_label=axis,
        series=clipped(lines, start, np.inf),
        bounds=limits,
    )


def fly(name: str, changes: Mapping[str, Any]) -> quadsim.Flight:
    """A scenario of the library with changes."""
    return quadsim.fly(quadsim.load(name, changes), progress=False)


def vehicle() -> Figure:
    """What `quadsim vehicle FILE --out` draws, of a vehicle with unequal arms."""
    dead_cat = quadsim.load_vehicle(str(ROOT / "tests" / "vehicles" / "deadcat.toml"))
    return replace(vehicle_figure(dead_cat), title="")


def linear() -> Figure:
    """The QP of one period: the plan with its bounds, and the optimum without."""
    import daqp

    start, k = fly("paper-constrained", {"duration": 11.0, **FREE}), 164
    problem = quadsim.problem("paper-constrained")
    state = np.array([start.state[name][k] for name in quadsim.STATE_NAMES])
    course = np.column_stack([*start.reference.values()])[k + 1 :]
    preview = np.vstack([course, np.repeat(course[-1:], problem.horizon, axis=0)])[: problem.horizon]
    H, f, G, low, high, u_min, u_max = problem.qp(state, preview, start.command[k - 1])
    plans = {
        "optimum without bounds": -np.linalg.solve(H, f),
        "optimum of the QP": daqp.solve(H, f, G, np.r_[u_max, high], np.r_[u_min, low])[0],
    }
    t = start.time[k] + 0.05 * np.arange(problem.horizon + 1)
    pitch, speed = [], []
    for colour, (label, plan) in zip((CYCLE[1], COLOUR.predicted), plans.items(), strict=True):
        u, states = plan.reshape(-1, 4), [state]
        for command in u:
            states.append(problem.model.A @ states[-1] + problem.model.B @ (command - problem.model.u_bar))
        angles = np.degrees(np.array(states)[:, quadsim.STATE_NAMES.index("pitch")])
        pitch.append(Series(x=t, y=angles, colour=colour, label=label))
        speed.append(Series(x=t, y=np.append(u[:, 0], u[-1, 0]), colour=colour, label=label, style="steps"))
    panels = (
        Panel(
            title="predicted pitch [deg]",
            y_label="pitch",
            series=tuple(pitch),
            bounds=(Bound(value=-5.0), Bound(value=5.0)),
        ),
        Panel(title="planned speed of rotor 1 [rad/s]", y_label="speed", series=tuple(speed)),
    )
    return Figure(key="linear", title="", panels=panels)


def effects() -> Figure:
    """What lag does to a command, and a gust to a hover."""
    climb = {"type": "setpoint", "at": 1.0, "z": 1.5}
    rotors = {"effects.rotors": {"rise": 0.05, "fall": 0.1}, "reference.response_time": None}
    lag = fly("hover", {"duration": 2.0, "controller": "lqr", "events": [climb], **rotors, **FREE}).log
    gust = fly("gust", FREE).log.plant
    assert gust.wind is not None
    rotor = (
        Series(x=lag.control.t, y=lag.control.speeds[:, 0], colour=COLOUR.reference, label="commanded", style="steps"),
        Series(x=lag.plant.t, y=lag.plant.speeds[:, 0], colour=COLOUR.flown, label="actual"),
    )
    pushed = (
        Series(x=gust.t, y=gust.wind[:, 0] / 10.0, colour=COLOUR.disturbance, label="wind [10 m/s]"),
        Series(x=gust.t, y=gust.state[:, POSITION][:, 0], colour=COLOUR.flown, label="position [m]"),
    )
    panels = (
        Panel(title="rotor 1 with lag", y_label="speed [rad/s]", series=clipped(rotor, 0.9, 1.6), x_label="time [s]"),
        Panel(title="a hover in a gust", y_label="along x", series=pushed, x_label="time [s]"),
    )
    return Figure(key="effects", title="", panels=panels)


def autopilot() -> Figure:
    """The first seconds of the targets of the scenario `autopilot`, and what was flown."""
    log = fly("autopilot", FREE).log
    target, rates, thrust = log.control.target, log.plant.body_rates, log.plant.thrust
    assert target is not None
    assert rates is not None
    panels = [
        Panel(
            title=title,
            unit=unit,
            series=clipped(
                (
                    Series(x=log.plant.t, y=flown, colour=COLOUR.flown, label="flown"),
                    Series(x=log.control.t, y=demanded, colour=COLOUR.reference, label="target", style="steps"),
                ),
                0.3,
                1.3,
            ),
            x_label="time [s]",
        )
        for title, unit, flown, demanded in (
            ("thrust", "N", thrust, target[:, 0]),
            ("pitch rate", "deg/s", np.degrees(rates[:, 1]), np.degrees(target[:, 2])),
        )
    ]
    return Figure(key="autopilot", title="", panels=tuple(panels))


def battery() -> Figure:
    """Thrust and body rates as a battery runs down, under three observers: distance from the course, thrust scale."""
    small = {"cells": 3, "capacity": 0.03, "resistance": 0.1, "charge": 0.8}
    changes = {"effects.battery": small, "effects.rotors": {}, "reference.acceleration": 0.5, **FREE}
    observers = {
        "no observer": {"controller.disturbance": None},
        "force": {"controller.disturbance.thrust_scale": False},
        "thrust scale": {},
    }
    flights = {label: fly("autopilot", {**changes, **observer}) for label, observer in observers.items()}
    missed = []
    for colour, (label, flight) in zip((CYCLE[1], CYCLE[2], CYCLE[0]), flights.items(), strict=True):
        away = np.linalg.norm([flight.state[axis] - flight.reference[axis] for axis in "xyz"], axis=0)
        missed.append(Series(x=flight.time, y=100.0 * away, colour=colour, label=label))
    scaled = flights["thrust scale"]
    log = scaled.log.plant
    assert log.battery is not None
    share = np.square(log.battery[:, 0] / (3 * LIPO[-1][1]))
    scale = (
        Series(x=log.t, y=share, colour=COLOUR.measured, label="(V / V0)^2"),
        Series(x=scaled.time, y=scaled.logged["thrust_scale"], colour=COLOUR.predicted, label="estimate"),
    )
    panels = (
        Panel(title="distance from the course [cm]", y_label="distance", series=tuple(missed)),
        Panel(title="thrust scale", series=scale),
    )
    return Figure(key="battery", title="", panels=panels)


def clipped(lines: Sequence[Series], start: float, stop: float) -> tuple[Series, ...]:
    """The part of curves from `start` to `stop`."""
    shown = [(line, (line.x >= start) & (line.x <= stop)) for line in lines]
    return tuple(replace(line, x=line.x[part], y=line.y[part]) for line, part in shown)


def space() -> Figure:
    """The half-spaces of one plan around a pillar, from above."""
    flight = fly("pillar", {})
    log, k = flight.log, int(np.searchsorted(flight.state["x"], 3.0))
    assert log.predicted is not None
    pillar = flight.scenario.obstacles[0]
    plan, centre = log.predicted[k][:, :2], np.array(pillar.position[:2])
    reach = pillar.radius + flight.vehicle.enclosing_radius + flight.scenario.controller.avoidance.margin
    planes = []
    for p in plan[np.linalg.norm(plan - centre, axis=1) < NEAR][::5]:
        n = (p - centre) / np.linalg.norm(p - centre)
        ends = centre + reach * n + np.array([[-0.6], [0.6]]) * np.array([-n[1], n[0]])
        planes.append(
            Series(x=ends[:, 0], y=ends[:, 1], colour=COLOUR.bound, label="half-space", dashed=True, width=0.9)
        )
    path, course = log.plant.state[:, POSITION], log.control.reference
    lines = (
        Series(x=course[:, 0], y=course[:, 1], colour=COLOUR.reference, label="reference", dashed=True),
        Series(x=path[:, 0], y=path[:, 1], colour=COLOUR.flown, label="flight"),
        Series(x=plan[:, 0], y=plan[:, 1], colour=COLOUR.predicted, label="plan", style="points", width=3.0),
    )
    panel = Panel(title="from above", x_label="x [m]", y_label="y [m]", equal=True, height=1.6,
                  areas=(Area(outline=outlines(pillar, 0.0)[0], colour=COLOUR.obstacle, label="pillar"),),
                  series=(*planes, *clipped(lines, 2.0, 6.0)))  # fmt: skip
    return Figure(key="space", title="", panels=(panel,), columns=1)


def learning() -> Figure:
    """A random agent in turbulence, alone and behind the safety filter."""
    example = run_path(str(ROOT / "examples" / "safety_filter.py"))
    scenario = example["filtered_air"]("turbulence").replace({"duration": 4.5})
    flights = {}
    for label in ("random agent", "behind the filter"):
        env: Any = quadsim.gym.make_env(scenario)
        if flights:
            env = quadsim.gym.MPCSafetyFilter(env)
        env.reset(seed=0)
        env.action_space.seed(0)
        ended = False
        while not ended:
            _, _, terminated, truncated, _ = env.step(env.action_space.sample())
            ended = terminated or truncated
        flights[label] = env.unwrapped.flight()
    panel = replace(curves("tilt", flights, bounds=(example["LARGEST"],)), y_range=(0.0, 20.0))
    return Figure(key="learning", title="", panels=(panel,), columns=1, end=5.0)


def ppo() -> Figure:
    """The learning curve of examples/ppo.py, which takes stable-baselines3 and five minutes: as it wrote it."""
    example, data = run_path(str(ROOT / "examples" / "ppo.py")), ROOT / "docs" / "data"
    curve = example["read_csv"](data / "ppo.csv", example["Rollout"])
    figure: Figure = example["curve_figure"](curve, example["read_csv"](data / "ppo-evaluation.csv", example["Score"]))
    return figure


def identification() -> Figure:
    """Velocity and body rate of a flight in gusts, measured and predicted half a second at a time."""
    eight = quadsim.scenario(vehicle="hummingbird", course="figure-eight", controller="geometric").scenario
    steps = [{"type": "setpoint", "at": 2.0 + 2.0 * i, "yaw": 30.0 * (-1) ** i} for i in range(10)]
    gusts = {"effects.air": {"turbulence": {"wind_speed_20ft": 8.0, "airspeed": 3.0}}, **FREE}
    brisk = {"reference.period": 3.2, "reference.ramp": 1.6, "reference.turns": 6, "control_period": 0.01}
    with tempfile.TemporaryDirectory() as folder:
        options: dict[str, Any] = {"video": False, "recording": False, "figures": False, "progress": False}
        quadsim.run(eight.replace({"events": steps, **gusts, **brisk}), out=f"{folder}/eight", **options)
        trace = quadsim.identify(f"{folder}/eight", vehicle="hummingbird").prediction.trace
    shown = trace_figure(trace)
    return replace(shown, key="identification", title="", panels=shown.panels[2:4], columns=1)


def betaflight() -> Figure:
    """A step of 1 m in y by one MPC through three autopilots; `make betaflight` builds two of them."""
    sys.path.append(str(ROOT / "benchmarks"))
    import autopilots

    make = run_path(str(autopilots.EXAMPLE))["Betaflight"]
    vehicle = quadsim.load_vehicle("hummingbird")
    flown = {"built-in": None, "Betaflight": make(vehicle), "stock gains": make(vehicle, stock=True)}
    steps = autopilots.scenario("steps").replace({"duration": 4.5})
    flights = {label: quadsim.fly(steps, autopilot=each, progress=False) for label, each in flown.items()}
    titles = {"y": "a step of 1 m at t = 3 s", "body_rate_x": "roll rate"}
    panels = tuple(
        replace(curves(name, flights, title, start=2.5), x_label="time [s]") for name, title in titles.items()
    )
    return Figure(key="betaflight", title="", panels=panels)


def chain() -> Figure:
    """Path, error and margin of the flight of examples/flight_chain.py, which takes a compiler and an emulator too."""
    sys.path.append(str(ROOT / "examples"))
    import flight_chain

    with tempfile.TemporaryDirectory() as folder:
        flight, _ = flight_chain.fly(Path(folder))
    return replace(signals([flight.run], flight_chain.SIGNALS), key="chain", title="")


FIGURES: Final[dict[str, Callable[[], Figure]]] = {
    made.__name__: made
    for made in (
        vehicle,
        linear,
        effects,
        autopilot,
        battery,
        space,
        learning,
        ppo,
        identification,
    )
}

OF_FIRMWARE: Final = {"betaflight": betaflight, "chain": chain}
"""Figures that are drawn only by name: they take a firmware."""


def main(names: Sequence[str]) -> None:
    """Write the figures named, or all of `FIGURES`."""
    figures.STYLE.update(figures.LOOKS)
    for name in names or FIGURES:
        (figures.ASSETS / f"{name}.svg").write_text(
            figures.to_svg({**FIGURES, **OF_FIRMWARE}[name]()), encoding="utf-8"
        )


if __name__ == "__main__":
    main(sys.argv[1:])
