"""Remake docs/verification.md: `make verification`.

Measures what tests/peers holds, with the same functions, and writes the figures with the peers' versions.  tests/peers
compares the page with today's figures.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from make_numbers import markdown, write_page
from peers import agreement, closed_loop, constrained_qp, gain, nonlinear_optimum, open_loop, recorded
from peers.agreement import Verdict
from peers.checks import HEAD, Check
from peers.closed_loop import ClosedLoop
from peers.constrained_qp import ConstrainedQP
from peers.gain import Comparison
from peers.nonlinear_optimum import LAGGED, PAPER, Agreement
from peers.open_loop import OpenLoop
from peers.rotorpy_plant import INTEGRATOR
from support import paper_problem
from threadpoolctl import threadpool_limits

from scenarios.loading import load_scenario
from scenarios.parts.vehicle import build_vehicle

INTRODUCTION = """\
# Verification

Is it right? Here quadsim is compared with software that others wrote, by figures that anyone can remake.
`make peers` installs the peers at the versions of `constraints.txt` and holds every check below;
`make verification` measures them again and writes this page. The code is in `tests/peers`, one file per
comparison. A page whose versions or digits are not today's fails `make peers`; figures that rounding decides may differ
tenfold, or be below 1e-7, and the rows of the solvers that fail now and then, osqp and proxqp, may be another day's.
"""


def open_loop_section(measured: OpenLoop) -> str:
    """The plant alone."""
    return f"""\
## The plant against RotorPy, open loop

RotorPy's `Multirotor` gets our vehicle's mass, inertia, arms, spins and coefficients, and rotor speeds as its input,
each held by one call of its `step`. It integrates rigid-body motion with scipy's DOP853 (order 8, here with a relative
tolerance of {INTEGRATOR["rtol"]:.0e}); quadsim has MuJoCo take Runge-Kutta steps of order 4 at 1 ms. Aerodynamics,
ground and noise are off. RotorPy's rotors follow tau_m dw/dt = w_commanded - w; each hold starts with w = w_commanded,
so that the speed is held exactly, whatever tau_m. The two share the parameters and nothing else.

{len(open_loop.SEEDS)} flights of {open_loop.HOLD * open_loop.HOLDS:g} s, each of {open_loop.HOLDS} random holds of
{open_loop.HOLD:g} s within {open_loop.AMPLITUDE:g} rad/s of hover: the vehicle
tilts by up to {np.degrees(measured.tilt):.0f} deg. Largest differences at the end of any hold, along any axis;
attitude is the angle of the rotation between the two:

{markdown([open_loop.HEAD, *measured.rows])}
The difference falls with the fourth power of MuJoCo's step: it is that integrator's error, and at this level nothing
else is left. The 1 ms that quadsim flies with need not be shorter. The last row shows what the comparison would see:
one moment of inertia off by a millionth.
"""


def closed_loop_section(measured: ClosedLoop) -> str:
    """The whole flight."""
    scenario = measured.scenario
    return f"""\
## The whole constrained flight on RotorPy's plant

`{scenario.name}`, {scenario.periods} periods, flown by the same loop (`quadsim.sim.loop.fly`), controller and
reference, once on MuJoCo and once on RotorPy's plant. The conversion from position, quaternion and body rates to the
paper's state is quadsim's in both. Whatever differs between the plants, and any command that jumps at a tiny change of
the state, would add up over {scenario.periods * scenario.control_period:g} s:

{markdown([closed_loop.HEAD, *measured.rows])}"""


def gain_section(measured: Sequence[Comparison]) -> str:
    """The unconstrained gain."""
    return f"""\
## The unconstrained gain against do-mpc's LQR and scipy's

The paper condenses the problem and solves for all N inputs at once, Eqs. (5)-(10) and (21)-(24). do-mpc's `LQR`
iterates the Riccati recursion, for j = N-1 .. 0 from Pi_N = P,

    K_j  = -(B' Pi_(j+1) B + R)^-1 B' Pi_(j+1) A
    Pi_j = Q + A' Pi_(j+1) A + A' Pi_(j+1) B K_j

and returns K_0, which minimises

    sum_(j=0..N-1) (x_j' Q x_j + u_j' R u_j) + x_N' P x_N.

The paper's cost weighs the outputs at k+1 .. k+N with Q_y and the inputs at k .. k+N-1 with Q_u. With
Q = P = C_r' Q_y C_r and R = Q_u the two differ by x_0' Q x_0 alone, which no input moves: so K_0 after N steps is K_N,
exactly. Relative differences (Frobenius) of K_N, with the weights of `{gain.SCENARIO}`:

{markdown([gain.HEAD, *(comparison.row for comparison in measured)])}
The third column explains the second: the condensed Hessian H grows ill-conditioned with N, and double precision
determines K_N no better than cond(H) times the unit roundoff. The fourth shows that the index matters: one step more is
another gain. The last is the paper's remark that K_N tends to the LQR's gain, by `scipy.linalg.solve_discrete_are`.
"""


def constrained_section(measured: ConstrainedQP) -> str:
    """The constrained QP."""
    return f"""\
## The constrained QP against qpmpc

The paper's constrained problem, rebuilt through qpmpc's own `MPCProblem` and solved by its `solve_mpc` (with quadprog,
an active-set method, exact to rounding). For x_(j+1) = A x_j + B v_j qpmpc minimises

    |x_N - goal|^2 + sum_(j=0..N-1) (|x_j - target_j|^2 + |v_j|^2)
    subject to   C x_j + D v_j <= e   for j = 0 .. N-1.

- Its weights are scalars, so the paper's go into the coordinates: x holds S xi, and v = R (u - u_bar), with S and R the
  square roots of the diagonal weights.
- States without weight are scaled by 2^-30. A power of two rounds nothing, and the weight that it leaves, 1e-18, is
  below the rounding of the others.
- The bounds on u(k+j) - u(k+j-1) need the input before: x holds it too, without weight, and starts with u(k-1).
- The paper weighs and bounds the outputs at k+1 .. k+N. So the output bounds are put on A x_j + B v_j, target_j is
  y_d(k+j) for j = 1 .. N-1, and goal is y_d(k+N); target_0 moves no input.

Both get the queries of the controller in each period of `{recorded.SCENARIO}`: state, desired outputs, input
before. In {measured.constrained.sum()} of the {measured.differences.size} periods a constraint is active;
exactly in the others the controller took the unconstrained optimum, without a QP. `{constrained_qp.OURS}`, the default
solver, differs by at most {measured.checks[0].row[2]}, where it stops iterating; how near the two problems
themselves are, the active-set solvers in the next table show.
"""


def agreement_section(measured: Sequence[Verdict]) -> str:
    """The solvers against one another."""
    slow = " and ".join(f"`{name}`" for name in agreement.SLOW)
    return f"""\
## The solvers against one another

Our solvers, four of qpsolvers and qpOASES, the paper's own, on the same recorded QPs. A solver's
own word is not taken: of each solution that it calls solved, the residuals of the Karush-Kuhn-Tucker conditions are
computed here, from the QP and the multipliers (`mpc.qp.kkt_residuals`), and the first input is compared with qpmpc's.
What it does not call solved is a failure. {slow} take long and give up on some QPs; they get every
{max(agreement.SLOW.values())}th period. The worst of all:

{markdown([agreement.HEAD, *(verdict.row for verdict in measured)])}
Stationarity is the largest entry of the Lagrangian's gradient, primal the largest violation [rad or rad/s],
complementarity the largest product of a multiplier and the distance to its bound; multipliers reach 1e3. Allowed are
{agreement.ALLOWED_DIFFERENCE:g} rad/s, and {agreement.ALLOWED_RESIDUAL:g} for each residual.
"""


def nonlinear_section(measured: Sequence[Agreement]) -> str:
    """Nonlinear MPC."""
    bounded = " and ".join(f"{agreement.bounded} of {2 * agreement.optima.size}" for agreement in measured)
    return f"""\
## Nonlinear MPC against CasADi and IPOPT

Two optimal control problems on the rigid body with a quaternion, written once more in CasADi from their formulas alone
(`tests/peers/casadi_ocp.py` imports nothing of quadsim), with all states as variables, and solved by IPOPT with exact
second derivatives. The first is that of Torrente et al. (RA-L 2021), section by section as `torrente-loop8-drag` flies
it. The second has N = 20 nodes, rotors that follow with a lag of {1e3 * LAGGED.lag:g} ms, the error-state attitude
q_r* q, a weight and a bound on steps of rotor speeds, and a soft bound of {np.degrees(LAGGED.tilt):g} deg on the tilt.
References are those of `{nonlinear_optimum.COURSE}`; states are random around them.

- Converged: the controller's `iterations` go on until nothing moves, and so do IPOPT's.
- Real-time iterations: one QP in each of many consecutive periods, linearised along the last plan. IPOPT gets the
  same QP from CasADi's derivatives, along its own last plan.

Whole plans are compared. In {bounded} problems a bound is active. The QPs are solved by `daqp`, to rounding:

{markdown([HEAD, *(check.row for agreement in measured for check in agreement.checks)])}"""


def main() -> None:
    """Measure everything and write it."""
    with threadpool_limits(limits=1):
        plant = open_loop.measure(build_vehicle(load_scenario(closed_loop.SCENARIO)))
        flight = closed_loop.measure()
        gains = gain.measure(paper_problem(gain.SCENARIO))
        problem, queries = recorded.record()
        qp = constrained_qp.measure(problem, queries)
        nonlinear = [nonlinear_optimum.measure(case) for case in (PAPER, LAGGED)]
        verdicts = [agreement.measure(name, problem, queries, qp.speeds) for name in agreement.PACKAGES]
    checks: list[Check] = [
        *plant.checks,
        *flight.checks,
        *(check for comparison in gains for check in comparison.checks),
        *qp.checks,
        *(check for found in nonlinear for check in found.checks),
    ]
    table = markdown([HEAD, *(check.row for check in checks)])
    write_page(
        "verification.md",
        INTRODUCTION,
        table,
        open_loop_section(plant),
        closed_loop_section(flight),
        gain_section(gains),
        constrained_section(qp),
        nonlinear_section(nonlinear),
        agreement_section(verdicts),
    )


if __name__ == "__main__":
    main()
