"""A problem of `peers.casadi_ocp` by do-mpc, which hands it to IPOPT."""

from __future__ import annotations

import warnings

import casadi as cs
import numpy as np
from peers.casadi_ocp import IPOPT, Array, Case, Found, following, residual


class DoMPC:
    """A case as do-mpc's controller of a discrete model, states and inputs of each node wanted as parameters in time.

    Args:
        case: with bounds on inputs alone.

    Raises:
        ValueError: the case has what is not built here.
    """

    def __init__(self, case: Case) -> None:
        if case.tilt or case.steps:
            raise ValueError(f"{case.name}: more than bounds on inputs")
        self._case = case
        with warnings.catch_warnings():
            # do-mpc warns of extras that are not installed, and CasADi of how do-mpc calls NumPy.
            warnings.simplefilter("ignore")
            self._build(case)

    def _build(self, case: Case) -> None:
        from do_mpc.controller import MPC
        from do_mpc.model import Model

        model = Model("discrete", "SX")
        x = model.set_variable("_x", "x", (case.n, 1))
        u = model.set_variable("_u", "u", (4, 1))
        x_r = model.set_variable("_tvp", "x_r", (13, 1))
        u_r = model.set_variable("_tvp", "u_r", (4, 1))
        model.set_rhs("x", following(case, x, u))
        model.setup()
        self._mpc = mpc = MPC(model)
        mpc.set_param(n_horizon=case.nodes, t_step=case.node, nlpsol_opts=IPOPT)
        # The cost of the first state, which no input changes, is a constant.
        mpc.set_objective(lterm=cs.sumsqr(residual(case, x, x_r)) + case.input * cs.sumsqr(u - u_r), mterm=cs.DM(0))
        mpc.set_rterm(u=case.move)
        mpc.bounds["lower", "_u", "u"] = 0.0
        mpc.bounds["upper", "_u", "u"] = 1.0
        self._wanted = mpc.get_tvp_template()
        mpc.set_tvp_fun(lambda _: self._wanted)
        mpc.setup()
        mpc.set_initial_guess()

    def optimum(self, x0: Array, x_r: Array, u_r: Array, before: Array) -> Found:
        """From a state (n,) and an input (4,), towards states (N + 1, 13) and inputs (N, 4), which it starts at."""
        mpc = self._mpc
        N = self._case.nodes
        rotors = np.concatenate([u_r, u_r[-1:]]) if self._case.lag else np.zeros((len(x_r), 0))
        for i, state in enumerate(np.hstack([x_r, rotors])):
            mpc.opt_x_num["_x", i, 0, -1] = state
        for i in range(N):
            mpc.opt_x_num["_u", i, 0] = u_r[i]
            self._wanted["_tvp", i, "x_r"] = x_r[i]
            self._wanted["_tvp", i, "u_r"] = u_r[i]
        mpc.u0 = before
        mpc.make_step(x0.reshape(-1, 1))
        states = np.hstack([mpc.opt_x_num["_x", i, 0, -1].full() for i in range(N + 1)]).T
        inputs = np.hstack([mpc.opt_x_num["_u", i, 0].full() for i in range(N)]).T
        return Found(states, inputs, bool(mpc.solver_stats["success"]))
