"""Processor time of nonlinear MPC: its step in C alone, with all Python around it, of whole flights, and of acados.

A period of a flight is solved again and again from the memory that it began with, plan and active set included; the
least of its times counts.  They are of the thread, of one foreign call of `quadsim_nmpc_step`: linearising, solving and
keeping the plan, and about a microsecond of ctypes.  Further flights, which nothing interrupts, time every step of the
law with its references, observers and checks, and the flight as a whole.

acados (Verschueren et al. 2022; real-time iteration, HPIPM) has the same problem, with bounds of the inputs alone, and
the same measured states, thrown off by a distance every 50 periods.
"""

from __future__ import annotations

import ctypes
import time as clock
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any, Final

import acados_rti
import numpy as np
from timing import Record, flown, options, run, undisturbed

import quadsim
from quadsim.commands.app import load
from quadsim.console.progress import Progress
from quadsim.errors import FlightError
from quadsim.mpc.laws.nonlinear import Nonlinear
from quadsim.mpc.laws.parts.nonlinear_mpc import NonlinearMPC
from quadsim.mpc.laws.parts.sqp import SQPStatus
from quadsim.mpc.pilot.pilot import Pilot
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.state import Array

LONGEST: Final = 10.0  # [s] that is flown of a longer flight
SHORT: Final = 1.0  # [s], with --quick
FLIGHTS: Final[dict[str, tuple[str, Mapping[str, Any]]]] = {
    "torrente-loop8-all": ("torrente-loop8-all", {}),
    "nonlinear": ("nonlinear", {}),
    "inverted-start": ("inverted-start", {}),
    "nonlinear; tilt 12 deg, soft": ("nonlinear", {"controller.tilt": 12.0, "controller.soft": {}}),
    "autopilot": ("autopilot", {}),
    "autopilot; N = 20, tilt 30 deg": (
        "autopilot",
        {"controller.horizon": 20, "controller.node": 0.02, "controller.tilt": 30.0},
    ),
    "autopilot; N = 40, tilt 20 deg": (
        "autopilot",
        {"controller.horizon": 40, "controller.node": 0.02, "controller.tilt": 20.0},
    ),
}
"""Flights by what a row says: a scenario, and what is changed of it."""
PEER_VEHICLE: Final = "torrente2021"
PEER_NODES: Final[Mapping[int, float]] = {10: 0.1, 20: 0.04, 40: 0.04}  # [s] from node to node, by their number
DISTANCES: Final = (0.1, 1.0, 4.0)  # [m]
PERIODS: Final = 300
THROWN_EVERY: Final = 50  # periods
OPTIMAL: Final = {SQPStatus.FREE, SQPStatus.BOUNDED, SQPStatus.UNCONVERGED}


class Replay:
    """Solves each period of a law several times from the same memory.

    Attributes:
        ms: the least processor time of each period.
        active: rows active at each optimum.
        iterations: changes of the active set and recursions of each period's last program.
    """

    def __init__(self, law: NonlinearMPC, repeats: int) -> None:
        self._law, self._solve, self._repeats = law, law.solve, repeats
        self._memory: tuple[Any, ...] = law._memory
        self.ms: list[float] = []
        self.active: list[int] = []
        self.iterations: list[int] = []

    def solve(self) -> SQPStatus:
        """See `NonlinearMPC.solve`."""
        law, spent = self._law, []
        work_now = law.struct.work
        memory: list[Any] = [part.copy() for part in self._memory]
        work = bytes(work_now)
        status = self._solve()
        for _ in range(self._repeats):
            for part, before in zip(self._memory, memory, strict=True):
                np.copyto(part, before)
            ctypes.memmove(ctypes.byref(work_now), work, len(work))
            started = clock.thread_time()
            again = law._library.quadsim_nmpc_step(*law._arguments)
            spent.append(clock.thread_time() - started)
            assert again == status
        self.ms.append(1e3 * min(spent))
        self.active.append(law.active)
        self.iterations.append(law.changes)
        return status


def law_of(flight: Rollout) -> NonlinearMPC:
    """The nonlinear law of a flight."""
    pilot = flight.loop.controller
    law = pilot.law if isinstance(pilot, Pilot) else pilot
    assert isinstance(law, NonlinearMPC)
    return law


def replayed(scenario: Scenario, repeats: int) -> Record:
    """Times of the C step alone in each period of a flight, and how large and how exact its programs were."""
    worst = 0.0
    with Rollout(scenario.replace({"controller.kkt_every": 1})) as flight:
        law = law_of(flight)
        replay = Replay(law, repeats)
        law.solve = replay.solve  # type: ignore[assignment, method-assign]
        try:
            while not flight.done:
                stats = flight.loop.step().command.stats
                residuals = stats.kkt_stationarity, stats.kkt_complementarity, stats.kkt_dual, stats.infeasibility
                worst = max(worst, float(np.nanmax(residuals)))
        except FlightError:
            pass
        return {
            "nodes": law.problem.horizon,
            "periods": len(replay.ms),
            "most_active": max(replay.active),
            "most_iterations": max(replay.iterations),
            "C_p50_ms": float(np.median(replay.ms)),
            "C_p99_ms": float(np.percentile(replay.ms, 99)),
            "KKT_worst": worst,
        }


def of_flights(quick: bool, report: Progress) -> Iterator[Record]:
    """A record of each flight."""
    for i, (name, (scenario_name, changes)) in enumerate(FLIGHTS.items()):
        report("flights", i, len(FLIGHTS))
        scenario = load(scenario_name)
        length = min(scenario.duration, SHORT if quick else LONGEST)
        scenario = scenario.replace({**changes, "duration": length, "constraints": []})
        record = {"flight": name, **replayed(scenario, 2 if quick else 5)}
        rounds = [flown(scenario) for _ in range(1 if quick else 3)]
        steps = 1e3 * np.min([controller for controller, *_ in rounds], axis=0)
        yield {
            **record,
            "step_p50_ms": float(np.median(steps)),
            "step_p99_ms": float(np.percentile(steps, 99)),
            "whole_us_per_step": 1e6 * min(whole / count for _, whole, count in rounds),
        }


class CoreRTI:
    """A law about one state at rest, timed as `acados_rti.AcadosRTI` is."""

    def __init__(self, law: NonlinearMPC, rest: Array, hover: Array, thrusts: Array) -> None:
        self._law, self._hover, nodes = law, hover, law.problem.horizon
        self._reference = np.tile(rest, (nodes + 1, 1)), np.tile(thrusts, (nodes, 1))

    def reset(self) -> None:
        """Forget the plan and the active set."""
        self._law.stored_plan = None

    def step(self, measured: Array) -> tuple[float, Array]:
        """Plan from a measured state (13,); return the processor time of the call [s], and the first input (4,)."""
        law = self._law
        for array, value in zip(law._asked, (measured, self._hover, *self._reference), strict=True):
            array[:] = value
        started = clock.thread_time()
        status = law._library.quadsim_nmpc_step(*law._arguments)
        spent = clock.thread_time() - started
        assert status in OPTIMAL
        return spent, law._u[0].copy()

    def thrown(self, rest: Array, distance: float) -> Iterator[Array]:
        """Yield measured states (13,): `rest` thrown off, then always what is planned from the last."""
        rng = np.random.default_rng(0)
        self.reset()
        for k in range(PERIODS):
            if k % THROWN_EVERY == 0:
                state = rest.copy()
                state[:3] += distance * rng.standard_normal(3)
            yield state
            self.step(state)
            state = self._law._x[1].copy()


def beside_acados(quick: bool, report: Progress) -> Iterator[Record]:
    """A record of each horizon and distance; of quadsim alone where acados is not installed."""
    horizons = list(PEER_NODES)[: 1 if quick else None]
    vehicle, rest = quadsim.load_vehicle(PEER_VEHICLE), np.zeros(13)
    rest[2] = rest[3] = 1.0
    for i, N in enumerate(horizons):
        report("acados", i, len(horizons))
        settings = Nonlinear(horizon=N, attitude_error="difference", terminal=1.0, shift=False)
        law = NonlinearMPC(vehicle, period=PEER_NODES[N], settings=settings)
        hover, thrusts = law.problem.model.u_bar, np.full(4, vehicle.mass * vehicle.gravity / 4.0)
        core = CoreRTI(law, rest, hover, thrusts)
        with acados_rti.acados(law.model, law.problem, rest) as peers:
            for distance in DISTANCES:
                record = compared({"C": core, **peers}, [*core.thrown(rest, distance)], 2 if quick else 7)
                yield {"case": f"N = {N}, {distance:g} m off", **record}


def compared(solvers: Mapping[str, CoreRTI | acados_rti.AcadosRTI], states: list[Array], passes: int) -> Record:
    """Time solvers on the same measured states, in turns; of each period the least of several passes counts."""
    ms: dict[str, list[list[float]]] = {name: [] for name in solvers}
    inputs: dict[str, Array] = {}
    for _ in range(passes):
        for name, solver in solvers.items():
            solver.reset()
            answers = [solver.step(state) for state in states]
            ms[name].append([1e3 * spent for spent, _ in answers])
            inputs[name] = np.array([first for _, first in answers])
    record: Record = {}
    for name, spent in ms.items():
        least = np.min(spent, axis=0)
        record |= {f"{name}_p50_ms": float(np.median(least)), f"{name}_p99_ms": float(np.percentile(least, 99))}
    if others := [name for name in solvers if name != "C"]:
        for quantile in ("p50", "p99"):
            better = min(record[f"{name}_{quantile}_ms"] for name in others)
            record[f"{quantile}_ratio"] = record[f"C_{quantile}_ms"] / better
        record["inputs_differ"] = max(float(np.abs(inputs[name] - inputs["C"]).max()) for name in others)
    return record


def measure(quick: bool, report: Progress) -> list[Record]:
    """The flights, then acados' cases."""
    with undisturbed():
        return [*of_flights(quick, report), *beside_acados(quick, report)]


def main() -> None:
    """Fly, solve, print and write."""
    chosen = options(__doc__)
    run(partial(measure, chosen.quick), "Processor time of nonlinear MPC", chosen.json)


if __name__ == "__main__":
    main()
