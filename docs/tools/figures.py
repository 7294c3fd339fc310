"""Figures 2 to 5 of the paper and those of the guides: `make numbers OPTIONS=pictures`, or some by name."""

from __future__ import annotations

import io
import re
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from runpy import run_path
from typing import Any, Final

import matplotlib as mpl
import numpy as np

import quadsim
import quadsim.gym
from quadsim.features.identify.identification_figures import trace_figure
from quadsim.flight.audit import SIGNALS
from quadsim.palette import COLOUR, CYCLE
from quadsim.report import flight_figures
from quadsim.report.figure import Area, Bound, Figure, Panel, Series, outlines
from quadsim.report.to_matplotlib import STYLE, draw
from quadsim.report.vehicle_drawing import vehicle_figure
from quadsim.sim.effects.battery import LIPO
from quadsim.state import POSITION, Array

ROOT: Final = Path(__file__).resolve().parents[2]
ASSETS: Final = ROOT / "docs" / "assets" / "figures"
WIDTH: Final = 6.4  # [in]
TEXT, GRID = "#3a4152", "#3a415226"
LOOKS: Final[dict[str, Any]] = {
    **{"axes.edgecolor": TEXT, "axes.labelcolor": TEXT, "text.color": TEXT, "grid.color": GRID},
    **dict.fromkeys(("xtick.color", "xtick.labelcolor", "ytick.color", "ytick.labelcolor"), TEXT),
    **{"svg.hashsalt": "quadsim", "svg.fonttype": "none", "font.family": "sans-serif", "path.simplify_threshold": 0.5},
}
"""Colours that show on light and on dark pages, and text as text."""
FREE: Final[dict[str, Any]] = {"constraints": []}
NEAR: Final = 1.2  # of a pillar, where half-spaces are drawn [m]
TIME: Final = "time [s]"


def to_svg(figure: Figure) -> str:
    """A figure without a background, coordinates to a tenth of a point."""
    file = io.StringIO()
    with mpl.rc_context(LOOKS):
        canvas = draw(figure)
        width, height = canvas.get_size_inches()
        canvas.set_size_inches(WIDTH, height * (WIDTH / width) ** 0.5)  # narrow, to be read on a phone as well
        canvas.savefig(file, format="svg", metadata={"Date": None}, transparent=True)
    return re.sub(r'="[^"]*"', lambda value: re.sub(r"(\d\.\d)\d+", r"\1", value[0]), file.getvalue())


def fly(name: str, changes: Mapping[str, Any]) -> quadsim.Flight:
    """A scenario of the library with changes."""
    return quadsim.fly(quadsim.load(name, changes), progress=False)


def line(x: Array, y: Array, colour: str, label: str, **looks: Any) -> Series:
    """A curve."""
    return Series(x=x, y=y, colour=colour, label=label, **looks)


def clipped(lines: Sequence[Series], start: float, stop: float = np.inf) -> tuple[Series, ...]:
    """The part of curves from `start` to `stop`."""
    shown = [(each, (each.x >= start) & (each.x <= stop)) for each in lines]
    return tuple(replace(each, x=each.x[part], y=each.y[part]) for each, part in shown)


def curves(name: str, flights: Mapping[str, quadsim.Flight], **looks: Any) -> Panel:
    """A signal of several flights, at the physics rate."""
    signal = SIGNALS[name]
    assert signal.plant is not None
    plants = {label: flight.log.plant for label, flight in flights.items()}
    lines = [line(log.t, signal.plant(log), CYCLE[i], label) for i, (label, log) in enumerate(plants.items())]
    return Panel(**{"title": name, "unit": signal.unit, **looks}, series=tuple(lines))


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
        pitch.append(line(t, np.degrees(np.array(states)[:, quadsim.STATE_NAMES.index("pitch")]), colour, label))
        speed.append(line(t, np.append(u[:, 0], u[-1, 0]), colour, label, style="steps"))
    bounds = (Bound(value=-5.0), Bound(value=5.0))
    panels = (
        Panel(title="predicted pitch [deg]", y_label="pitch", series=tuple(pitch), bounds=bounds),
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
        line(lag.control.t, lag.control.speeds[:, 0], COLOUR.reference, "commanded", style="steps"),
        line(lag.plant.t, lag.plant.speeds[:, 0], COLOUR.flown, "actual"),
    )
    pushed = (
        line(gust.t, gust.wind[:, 0] / 10.0, COLOUR.disturbance, "wind [10 m/s]"),
        line(gust.t, gust.state[:, POSITION][:, 0], COLOUR.flown, "position [m]"),
    )
    panels = (
        Panel(title="rotor 1 with lag", y_label="speed [rad/s]", series=clipped(rotor, 0.9, 1.6), x_label=TIME),
        Panel(title="a hover in a gust", y_label="along x", series=pushed, x_label=TIME),
    )
    return Figure(key="effects", title="", panels=panels)


def autopilot() -> Figure:
    """The first seconds of the targets of the scenario `autopilot`, and what was flown."""
    log = fly("autopilot", FREE).log
    target, rates, thrust = log.control.target, log.plant.body_rates, log.plant.thrust
    assert target is not None
    assert rates is not None
    assert thrust is not None
    shown = {
        ("thrust", "N"): (thrust, target[:, 0]),
        ("pitch rate", "deg/s"): (np.degrees(rates[:, 1]), np.degrees(target[:, 2])),
    }
    panels = []
    for (title, unit), (flown, demanded) in shown.items():
        lines = (
            line(log.plant.t, flown, COLOUR.flown, "flown"),
            line(log.control.t, demanded, COLOUR.reference, "target", style="steps"),
        )
        panels.append(Panel(title=title, unit=unit, series=clipped(lines, 0.3, 1.3), x_label=TIME))
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
        missed.append(line(flight.time, 100.0 * away, colour, label))
    scaled = flights["thrust scale"]
    log = scaled.log.plant
    assert log.battery is not None
    scale = (
        line(log.t, np.square(log.battery[:, 0] / (3 * LIPO[-1][1])), COLOUR.measured, "(V / V0)^2"),
        line(scaled.time, scaled.logged["thrust_scale"], COLOUR.predicted, "estimate"),
    )
    panels = (
        Panel(title="distance from the course [cm]", y_label="distance", series=tuple(missed)),
        Panel(title="thrust scale", series=scale),
    )
    return Figure(key="battery", title="", panels=panels)


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
        planes.append(line(ends[:, 0], ends[:, 1], COLOUR.bound, "half-space", dashed=True, width=0.9))
    path, course = log.plant.state[:, POSITION], log.control.reference
    lines = (
        line(course[:, 0], course[:, 1], COLOUR.reference, "reference", dashed=True),
        line(path[:, 0], path[:, 1], COLOUR.flown, "flight"),
        line(plan[:, 0], plan[:, 1], COLOUR.predicted, "plan", style="points", width=3.0),
    )
    areas = (Area(outline=outlines(pillar, 0.0)[0], colour=COLOUR.obstacle, label="pillar"),)
    looks: dict[str, Any] = {"x_label": "x [m]", "y_label": "y [m]", "equal": True, "height": 1.6, "areas": areas}
    panel = Panel(title="from above", series=(*planes, *clipped(lines, 2.0, 6.0)), **looks)
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
    panel = curves("tilt", flights, bounds=(Bound(value=example["LARGEST"]),), y_range=(0.0, 20.0))
    return Figure(key="learning", title="", panels=(panel,), columns=1, end=5.0)


def ppo() -> Figure:
    """The learning curve of examples/ppo.py, as `make numbers OPTIONS=ppo` wrote it."""
    sys.path.append(str(ROOT / "examples"))
    import ppo

    figure: Figure = ppo.curve_figure(ppo.read_curve(ROOT / "docs" / "data" / "ppo.csv"))
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
    panels = []
    for name, title in {"y": "a step of 1 m at t = 3 s", "body_rate_x": "roll rate"}.items():
        shown = curves(name, flights, title=title, unit="", y_label=f"{name} [{SIGNALS[name].unit}]", x_label=TIME)
        panels.append(replace(shown, series=clipped(shown.series, 2.5)))
    return Figure(key="betaflight", title="", panels=tuple(panels))


def chain() -> Figure:
    """Path, error and margin of the flight of examples/flight_chain.py, which takes a compiler and an emulator too."""
    sys.path.append(str(ROOT / "examples"))
    import flight_chain

    with tempfile.TemporaryDirectory() as folder:
        flight, _ = flight_chain.fly(Path(folder))
    return replace(flight_figures.signals([flight], flight_chain.SIGNALS), key="chain", title="")


OF_GUIDES: Final[tuple[Callable[[], Figure], ...]] = (
    *(vehicle, linear, effects, autopilot, battery, space, learning, ppo, identification),
)
OF_FIRMWARE: Final = (betaflight, chain)
"""Figures that are drawn only by name: they take a firmware."""


def paper() -> list[Figure]:
    """Figures 2 to 5."""
    made = []
    for name, keys in flight_figures.PAPER_FIGURES.items():
        run = quadsim.fly(name, progress=False)
        for key, figure in zip(keys, (flight_figures.states([run]), flight_figures.inputs([run])), strict=True):
            made.append(replace(figure, key=key.rstrip("_"), title=""))
    return made


def main(names: Sequence[str]) -> None:
    """Write the figures named, or those of the paper and of the guides."""
    STYLE.update(LOOKS)
    makers = {each.__name__: each for each in (*OF_GUIDES, *OF_FIRMWARE)}
    made = [makers[name]() for name in names] or [*paper(), *(each() for each in OF_GUIDES)]
    for figure in made:
        (ASSETS / f"{figure.key}.svg").write_text(to_svg(figure), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
