"""Remake the section of docs/performance.md on steps of nonlinear MPC: `make nonlinear`.

The controller's queries in two flights are given to it with several QP solvers, to acados' real-time iteration, to
IPOPT and to do-mpc, in turns (`scenarios.bench.timing`).
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time as clock
from pathlib import Path
from typing import Any, Final

import numpy as np
from acados_rti import AcadosRTI
from make_numbers import ROOT, Table, markdown, write_page
from make_performance import NONLINEAR as TITLE
from make_robust_step import TITLE as NEXT
from peers.casadi_ocp import Case, Peer
from peers.do_mpc_ocp import DoMPC
from peers.nonlinear_optimum import ALLOWED, PAPER

from mpc.nonlinear.controller import NonlinearMPC
from mpc.nonlinear.reference import nodes_of_motion
from quadsim.controller import ACCEPTED, UNCONSTRAINED, Command, Moment
from quadsim.state import POSITIONS, VELOCITIES, Array
from scenarios.bench.queries import flight_between
from scenarios.bench.timing import segments, time_in_turns
from scenarios.build import build_controller
from scenarios.loading import load_scenario
from scenarios.machine import machine
from scenarios.parts.vehicle import build_vehicle
from scenarios.run import fly_scenario

PAGE: Final = ROOT / "docs" / "performance.md"
LAGGED: Final = Case(name="rotor lag, N = 20", nodes=20, node=0.06, lag=0.02)
FLIGHTS: Final[dict[str, tuple[Case, list[str]]]] = {
    "torrente-loop8-drag": (PAPER, []),
    "torrente-lemniscate8-drag": (PAPER, []),
    "torrente-loop8-drag, N = 20, rotor lag": (
        LAGGED, ["controller.node=0.06", "controller.horizon=60", "controller.rotor_lag=0.02"]
    ),
}  # fmt: skip
SOLVERS: Final = ("daqp", "piqp-multistage")
"""Besides the default."""
REPEATS: Final = 3
PATIENT: Final = 20.0
"""A candidate whose first pass takes longer [s] makes no other."""
TARGETS: Final = {10: (0.30, 1.0), 20: (1.5, math.inf)}
"""Largest p50 and p99 of the default by N [ms]."""
TEXT: Final = """\
`make nonlinear` remakes this section; processor time, on one machine ({processor}, {cores} cores), each table in one
run: read the ratios. The controller's queries in flights of the library, {timed} periods of each, are given to it
with other QP solvers, and to the same optimal control problem in CasADi (`tests/peers/casadi_ocp.py`), solved by
acados, by IPOPT, and by do-mpc, which calls IPOPT. As in the tables above the plant flies a period between two steps,
and each step is the median of its repeats. IPOPT starts along the reference each time and converges; the others do in
each segment of 20 periods, go on along their own last plan, and take one step of the real-time iteration. u0 difference
is the largest of a rotor's first input from `daqp`'s, as a share of the largest.

{tables}
- The unconstrained optimum satisfies all bounds in {free} of these periods: condensed, it is then found by one
  Cholesky factorisation, whatever the solver. Elsewhere the difference is what PIQP's tolerance leaves.
- acados is generated C (`SQP_RTI`, partial condensing, HPIPM), called from Python with the references of all nodes;
  ours is NumPy.
- IPOPT's differences are those of converged optima from one step of the real-time iteration. With ours converged as
  well, `tests/peers` holds both IPOPT's and do-mpc's inputs to {ALLOWED:g} of the largest.
- acados is no peer of `make peers`: its wheel, `comma-deps-acados`, brings a slim `casadi` that would overwrite the
  peers', its libraries find one another only when loaded in turn, and a problem takes a C compiler. `make nonlinear`
  installs it in a directory of its own.
"""


class Recorder:
    """A controller whose queries are recorded."""

    def __init__(self, law: NonlinearMPC) -> None:
        self.law, self.horizon, self.name, self.solver = law, law.horizon, law.name, law.solver
        self.queries: list[tuple[Moment, Array, Array]] = []

    def reset(self, speeds: Array) -> None:
        """See `quadsim.controller.Controller`."""
        self.law.reset(speeds)

    def step(self, now: Moment, state: Array, reference: Array) -> Command:
        """Record the query, and answer it."""
        self.queries.append((now, state.copy(), reference.copy()))
        return self.law.step(now, state, reference)

    def predict(self, states: Array, plans: Array) -> Array:
        """See `quadsim.controller.Controller`."""
        return self.law.predict(states, plans)


class Ours:
    """Our controller as a candidate; see `scenarios.bench.timing.Candidate`."""

    def __init__(self, law: NonlinearMPC, queries: list[tuple[Moment, Array, Array]]) -> None:
        self._law, self._queries, self._period = law, queries, -2
        self.first: dict[int, Array] = {}
        self.statuses: dict[int, str] = {}

    def prepare(self, period: int) -> None:
        """See `scenarios.bench.timing.Candidate.prepare`; after a gap, start anew."""
        moment, state, reference = self._queries[period]
        if period != self._period + 1:
            self._law.reset(moment.acting)
        self._period, self._question = period, (moment, state, reference)

    def answer(self) -> None:
        """See `scenarios.bench.timing.Candidate.answer`."""
        command = self._law.step(*self._question)
        self.first.setdefault(self._period, np.square(command.speeds / 1000.0))
        self.statuses.setdefault(self._period, command.status)


class InCasadi:
    """A case by acados, IPOPT or do-mpc as a candidate, with a case's states and nodes made before the clock starts."""

    def __init__(self, case: Case, solver: AcadosRTI | Peer | DoMPC, law: NonlinearMPC, queries: list[Any]) -> None:
        self._case, self._solver, self._law, self._queries, self._period = case, solver, law, queries, -2
        self.first: dict[int, Array] = {}
        self.failures = 0

    def prepare(self, period: int) -> None:
        """See `scenarios.bench.timing.Candidate.prepare`; after a gap, start anew."""
        moment, state, _ = self._queries[period]
        nodes = nodes_of_motion(moment.motion, self._case.nodes, self._law.settings.stride)
        before, inputs = np.square(moment.acting / 1000.0), nodes.thrusts / 20.0
        if period != self._period + 1:
            self._rotors = before
            self._new = True
        elif self._case.lag:
            left = math.exp(-0.02 / self._case.lag)
            self._rotors = before + left * (self._rotors - before)
        x = np.concatenate([state[POSITIONS], moment.attitude, state[VELOCITIES], moment.body_rates])
        if self._case.lag:
            x = np.concatenate([x, self._rotors])
        if self._new and isinstance(self._solver, AcadosRTI):
            rotors = np.concatenate([inputs, inputs[-1:]])[:, : x.size - 13]
            self._solver.start(np.hstack([nodes.states, rotors]), np.clip(inputs, 0.0, 1.0))
        self._new, self._period = False, period
        self._question = x, nodes.states, inputs
        self._before = before

    def answer(self) -> None:
        """See `scenarios.bench.timing.Candidate.answer`."""
        if isinstance(self._solver, AcadosRTI):
            status, first = self._solver.step(*self._question)
            failed = status != 0
        else:
            found = self._solver.optimum(*self._question, self._before)
            first, failed = found.inputs[0], not found.solved
        self.failures += failed
        self.first.setdefault(self._period, first)


def measure(name: str, directory: Path, scratch: Path, stride: int) -> tuple[Table, str, Table, int]:
    """A table of one flight's steps, how many are free, its targets, and how many steps there are."""
    case, settings = FLIGHTS[name]
    scenario = load_scenario(name.partition(",")[0], settings)
    vehicle = build_vehicle(scenario)

    def law(**of_controller: Any) -> NonlinearMPC:
        changed = scenario.model_copy(update={"controller": scenario.controller.model_copy(update=of_controller)})
        made = build_controller(changed, vehicle)
        assert isinstance(made, NonlinearMPC)
        return made

    recorder = Recorder(law())
    fly_scenario(scenario, law=recorder)
    default = Ours(law(), recorder.queries)
    acados = InCasadi(case, AcadosRTI(case, directory, scratch), recorder.law, recorder.queries)
    candidates: dict[str, Any] = {
        f"{recorder.law.solver} (default)": default,
        **{solver: Ours(law(solver=solver), recorder.queries) for solver in SOLVERS},
        "acados, HPIPM": acados,
        "IPOPT through CasADi": InCasadi(case, Peer(case), recorder.law, recorder.queries),
        "IPOPT through do-mpc": InCasadi(case, DoMPC(case), recorder.law, recorder.queries),
    }
    timed = segments(len(recorder.queries), stride)
    periods = [period for segment in timed for period in segment]
    with flight_between(scenario, vehicle) as between:
        laps = time_in_turns(
            candidates,
            timed,
            between=between,
            repeats=REPEATS,
            rng=np.random.default_rng(0),
            longest_pass=PATIENT,
            now=clock.thread_time,
        )
    p50, p99 = np.percentile(laps[next(iter(candidates))].median, [50.0, 99.0])
    exact = candidates[SOLVERS[0]].first
    head = f"`{name.partition(',')[0]}`, {case.name.partition(', ')[2]} [ms]"
    rows: Table = [(head, "p50", "p99", "max", "p50, ratio", "u0 difference")]
    for each, candidate in candidates.items():
        ms = laps[each].median
        apart = max(np.abs(candidate.first[k] - exact[k]).max() for k in periods)
        middle, late = np.percentile(ms, [50.0, 99.0])
        rows.append((each, f"{middle:.3f}", f"{late:.3f}", f"{ms.max():.3f}", f"{middle / p50:.2f}", f"{apart:.0e}"))
    assert all(default.statuses[k] in ACCEPTED for k in periods)
    assert not any(candidate.failures for candidate in candidates.values() if isinstance(candidate, InCasadi))
    free = sum(default.statuses[k] == UNCONSTRAINED for k in periods)
    most, latest = TARGETS[case.nodes]
    targets = [(f"`{name}`, p50", f"<= {most:g} ms", f"{p50:.2f} ms", "met" if p50 <= most else "missed")]
    if math.isfinite(latest):
        targets.append((f"`{name}`, p99", f"<= {latest:g} ms", f"{p99:.2f} ms", "met" if p99 <= latest else "missed"))
    return rows, str(free), targets, len(periods)


def main() -> None:
    """Measure everything and write the section."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("acados", type=Path, help="the directory that comma-deps-acados is installed in")
    parser.add_argument("--stride", type=int, default=5, help="one segment of 20 periods in this number is timed")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        found = [measure(name, options.acados, Path(scratch), options.stride) for name in FLIGHTS]
    targets: Table = [("quantity", "target", "measured", "verdict"), *(row for each in found for row in each[2])]
    tables = "\n".join([*(markdown(each[0]) for each in found), markdown(targets)])
    free = ", ".join(each[1] for each in found[:-1]) + f" and {found[-1][1]}"
    section = f"{TITLE}\n\n{TEXT.format(ALLOWED=ALLOWED, tables=tables, free=free, timed=found[0][3], **machine())}\n"
    start, title, rest = PAGE.read_text(encoding="utf-8").partition(TITLE)
    if not title:
        start, before, rest = start.partition(NEXT)
        rest = before + rest
    write_page(PAGE.name, start + section + "".join(rest.partition(NEXT)[1:]))


if __name__ == "__main__":
    main()
