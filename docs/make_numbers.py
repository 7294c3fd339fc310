"""Remake what README.md and docs/numbers.md report of the paper's flights and of the mathematics: `make numbers`.

No clock decides any of it, and tests/test_documents.py holds most of it.  docs/make_performance.py makes the rest.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import scipy.linalg
from PIL import Image

from mpc.model import hover_model
from mpc.paper.prediction import rollout
from mpc.unconstrained import sequence_gains
from quadsim.controller import ACCEPTED
from quadsim.sim.airframe import compile_model, rotor_thrusts
from quadsim.sim.plant import Plant
from quadsim.state import REFERENCE_STATES, Array, make_state
from quadsim.vehicle import Vehicle
from scenarios.build import build_problem
from scenarios.cost.measure import fly_variations
from scenarios.cost.study import Variation
from scenarios.flight import Flight, summarise
from scenarios.loading import load_scenario
from scenarios.parts.vehicle import build_vehicle
from scenarios.run import fly_scenario

ROOT = Path(__file__).resolve().parent.parent
PERIOD = 0.05
FORMS = ("piqp-dense", "piqp-multistage")
MUJOCO_ORDER = [0, 6, 1, 7, 2, 8, 3, 9, 4, 10, 5, 11]
"""Where the paper's states are among MuJoCo's tangent coordinates (positions, rotations, then their rates)."""

Table = list[tuple[str, ...]]


def fly(name: str, *settings: str) -> Flight:
    """Fly a scenario of the library."""
    return fly_scenario(load_scenario(name, settings))


def margin(flight: Flight, name: str) -> str:
    """The verdict on a bound, the signed margin that decides it, and the time beyond it at the physics rate."""
    finding = next(finding for finding in flight.findings if finding.limit.name == name)
    decides, unit = finding.deciding_margin, finding.limit.unit
    if finding.satisfied:
        return f"held ({round(decides, 3) + 0.0:.3f} {unit})"
    if not finding.time_violated:
        return f"violated by commands ({decides:.2f} {unit}), rotors held"
    return f"violated ({decides:.2f} {unit}), {finding.time_violated:.2f} s"


def results(flights: dict[str, Flight]) -> Table:
    """The paper's flights side by side: tracking, bounds, extremes."""
    rows: Table = [("", *flights)]
    every = list(flights.values())
    numbers = [summarise(flight) for flight in every]
    for channel, unit, scale in (("x", "m", 1.0), ("y", "m", 1.0), ("z", "m", 1.0), ("yaw", "deg", np.degrees(1.0))):
        values = (f"{scale * summary['tracking']['rmse'][channel]:.3f}" for summary in numbers)
        rows.append((f"RMS error {channel} [{unit}]", *values))
    worst = (max(abs(value) for value in summary["tracking"]["final_error"].values()) for summary in numbers)
    rows.append(("largest error at the end [m, rad]", *(f"{value:.0e}" for value in worst)))
    for name, label in (("roll", "roll within 5 deg"), ("pitch", "pitch within 5 deg")):
        rows.append((label, *(margin(flight, name) for flight in every)))
    rows.append(("speeds within 0 .. 250 rad/s", *(margin(flight, "speed") for flight in every)))
    rows.append(("steps within -10 .. 5 rad/s", *(margin(flight, "slew") for flight in every)))
    rows.append(("highest rotor speed acting [rad/s]", *(f"{flight.log.plant.speeds.max():.1f}" for flight in every)))
    rows.append(("largest step commanded [rad/s]", *(f"{np.abs(f.log.control.slews).max():.1f}" for f in every)))
    variation = (f"{summary['control']['total_variation']:.0f}" for summary in numbers)
    rows.append(("total variation of the commands [rad/s]", *variation))
    found = (f"{count_optimal(flight)} of {flight.log.control.t.size}" for flight in every)
    rows.append(("periods with their optimum found", *found))
    return rows


def count_optimal(flight: Flight) -> int:
    """Periods whose command is their optimum: found by QPs, or by the unconstrained optimum that is feasible."""
    return sum(status in ACCEPTED for status in flight.log.control.status)


def lqr_convergence() -> Table:
    """The relative difference of K_N from scipy's discrete LQR gain."""
    scenario = load_scenario("paper-unconstrained")
    problem = build_problem(scenario, build_vehicle(scenario))
    A, B, objective = problem.model.A, problem.model.B, problem.objective
    P = scipy.linalg.solve_discrete_are(A, B, objective.Q_y, objective.Q_u)
    lqr = -np.linalg.solve(objective.Q_u + B.T @ P @ B, B.T @ P @ A)
    rows: Table = [("N", "relative difference")]
    for horizon in (10, 20, 40, 60, 80, 100):
        K_N = sequence_gains(replace(problem, horizon=horizon)).first().K_N
        rows.append((str(horizon), f"{np.linalg.norm(K_N - lqr) / np.linalg.norm(lqr):.1e}"))
    return rows


def prediction_error(vehicle: Vehicle, steps: int, size: float) -> float:
    """Largest difference between the linear prediction and MuJoCo after a deviation of relative size `size`."""
    model = hover_model(vehicle, PERIOD)
    rng = np.random.default_rng(7)
    state = make_state(position=(1.0, 2.0, 3.0)) + 0.1 * size * rng.uniform(-1, 1, 12)
    plan = model.u_bar + 0.5 * size * rng.uniform(-1, 1, (steps, 4))
    flown = []
    with Plant(vehicle) as plant:
        plant.reset(state)
        for speeds in plan:
            plant.advance(speeds, 50)
            flown.append(plant.state())
    return float(np.abs(rollout(model, state[None], plan[None])[0] - np.array(flown)).max())


def prediction_errors(vehicle: Vehicle) -> Table:
    """Linear prediction against MuJoCo for ever smaller deviations from hover."""
    rows: Table = [("size of the deviation", "after 1 step", "after 50 steps")]
    for size in (0.1, 0.05, 0.025, 0.0125):
        rows.append((f"{size:g}", *(f"{prediction_error(vehicle, steps, size):.2e}" for steps in (1, 50))))
    return rows


def mujoco_transition(vehicle: Vehicle, timestep: float) -> tuple[Array, Array]:
    """A and B over one control period by `mjd_transitionFD` at hover, in the paper's coordinates.

    MuJoCo does not differentiate its Runge-Kutta steps, so these are of its first-order Euler integrator.
    """
    model = compile_model(vehicle, timestep=timestep)
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    data = mujoco.MjData(model)
    data.ctrl[:] = rotor_thrusts(vehicle, np.full(4, vehicle.hover_speed))
    A, B = np.zeros((12, 12)), np.zeros((12, 4))
    mujoco.mjd_transitionFD(model, data, 1e-6, True, A, B, None, None)
    A = A[np.ix_(MUJOCO_ORDER, MUJOCO_ORDER)]
    B = B[MUJOCO_ORDER] * 2.0 * vehicle.thrust_coefficient * vehicle.hover_speed  # thrust slope dT/dw = 2 b w
    whole_A, whole_B = np.eye(12), np.zeros((12, 4))
    for _ in range(round(PERIOD / timestep)):
        whole_A, whole_B = A @ whole_A, A @ whole_B + B
    return whole_A, whole_B


def transition_difference(vehicle: Vehicle) -> float:
    """Largest difference of A and B from MuJoCo's, in the limit of a vanishing step (Richardson extrapolation)."""
    exact = hover_model(vehicle, PERIOD)
    coarse, fine = mujoco_transition(vehicle, 1e-3), mujoco_transition(vehicle, 5e-4)
    limits = (2.0 * two - one for one, two in zip(coarse, fine, strict=True))
    return float(max(np.abs(limit - part).max() for limit, part in zip(limits, (exact.A, exact.B), strict=True)))


def targets(constrained: Flight, variations: Sequence[Variation]) -> Table:
    """Targets for the flights and the mathematics, and what is measured."""
    found = {finding.limit.name: finding for finding in constrained.findings}
    tilt, inputs = [found["roll"], found["pitch"]], [found["speed"], found["slew"]]
    control = constrained.log.control
    end = np.abs(control.state[-1, list(REFERENCE_STATES)] - control.reference[-1]).max()
    gains, errors = lqr_convergence(), prediction_errors(constrained.vehicle)
    orders = [np.log2(float(errors[-2][i]) / float(errors[-1][i])) for i in (1, 2)]
    varied = max(variation.outcome.numbers["tilt_plant"] for variation in variations)
    beyond = max(0.0, *(-min(finding.worst_margin, finding.worst_margin_sampled) for finding in inputs))
    return [
        ("paper-constrained, and the mathematics", "target", "measured"),
        ("roll, pitch beyond 5 deg at the samples", "<= 0.01 deg", f"{-min(f.worst_margin_sampled for f in tilt):.4f}"),
        ("roll, pitch beyond 5 deg at 1 kHz", "<= 0.05 deg", f"{-min(f.worst_margin for f in tilt):.3f}"),
        ("the same over L and d/b, worst of nine", "<= 0.1 deg", f"{varied - 5.0:.3f}"),
        ("speeds and steps beyond their bounds", "<= 1e-6 rad/s", f"{beyond:.1g}"),
        ("highest speed in the take-off", "250 rad/s", f"{control.speeds[control.t < 10.0].max():.6f}"),
        ("largest error of x, y, z [m], yaw [rad] at the end", "<= 0.01", f"{end:.0e}"),
        ("solved, or the unconstrained optimum feasible", "1200", str(count_optimal(constrained))),
        (
            "commands by `piqp-dense` and `piqp-multistage` differ by",
            "<= 0.01 rad/s",
            f"{solver_difference():.1g}",
        ),
        ("K_N from the LQR's gain, N = 100, relative", "< 1e-3", gains[-1][1]),
        ("A, B from `mjd_transitionFD`", "-", f"{transition_difference(constrained.vehicle):.0e}"),
        ("order of the prediction error, 1 and 50 steps", "2", " and ".join(f"{order:.2f}" for order in orders)),
    ]


def markdown(rows: Table) -> str:
    """Rows as a Markdown table, the first as its head."""
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join([lines[0], "|" + " --- |" * len(rows[0]), *lines[1:]]) + "\n"


def replace_in(page: Path, name: str, table: str, *, command: str = "make numbers") -> None:
    """Put a table between the markers of that name in a page, which also name the command that makes it."""
    begin, end = f"<!-- {name}: made by `{command}` -->", f"<!-- {name} end -->"
    head, _, rest = page.read_text(encoding="utf-8").partition(begin)
    page.write_text(f"{head}{begin}\n\n{table}\n{end}{rest.partition(end)[2]}", encoding="utf-8")


def write_page(name: str, *parts: str) -> None:
    """Write a page of docs/, its parts a line apart."""
    (ROOT / "docs" / name).write_text("\n".join(parts), encoding="utf-8")


def copy_figure(drawn: Path, name: str, colours: int) -> None:
    """Put a figure into docs/ with this many colours, which makes it small."""
    figure = Image.open(drawn).convert("RGB")
    figure.quantize(colours, dither=Image.Dither.NONE).save(ROOT / "docs" / name, optimize=True)


@functools.cache
def solver_difference(duration: float = 30.0) -> float:
    """Largest difference in command between `piqp-dense` and `piqp-multistage` over this much of the flight [rad/s].

    Both solve a QP in every period: the exact optimum without one is the same for both.
    """
    settings = (f"duration={duration}", "controller.shortcut=false")
    flights = [fly("paper-constrained", f"controller.solver={name}", *settings) for name in FORMS]
    return float(np.abs(np.subtract(*(flight.log.control.speeds for flight in flights))).max())


def main() -> None:
    """Measure everything and write it."""
    names = ("paper-unconstrained", "paper-unconstrained-clipped", "paper-constrained")
    flights = {name: fly(name) for name in names}
    constrained = flights["paper-constrained"]
    table, variations = markdown(results(flights)), fly_variations(load_scenario("paper-constrained"))
    write_page(
        "numbers.md",
        "# The numbers\n\nMade by `make numbers`; nothing here is typed by hand.\n",
        f"## The paper's flights\n\n{table}",
        "In brackets is the margin that decides, negative beyond the bound. A bound that is *held* may be exceeded\n"
        "between the samples within the audit's tolerance, 0.05 deg for tilt. Seconds are those beyond bound and\n"
        "tolerance, at the physics rate; for steps, which exist once per period, at the samples.\n",
        "The same over the parameters that the paper leaves out, L and d/b, is in\n"
        "[constraints-cost.md](constraints-cost.md).\n",
        f"## Targets of the flights and of the mathematics\n\n{markdown(targets(constrained, variations))}",
        f"## K_N against the discrete LQR gain\n\n{markdown(lqr_convergence())}",
        f"## Linear prediction against MuJoCo near hover\n\n{markdown(prediction_errors(constrained.vehicle))}",
        "The error falls by four as the deviation halves: quadratically.\n",
        "## The two forms of the QP\n\nLargest difference between the commands of `piqp-dense` and `piqp-multistage`\n"
        f"over 30 s of the constrained flight, with a QP in every period: {solver_difference():.1e} rad/s.\n",
    )
    replace_in(ROOT / "README.md", "results", table)


if __name__ == "__main__":
    main()
