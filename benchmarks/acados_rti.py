"""acados' real-time iteration with HPIPM on the problem of a `NonlinearMPC`: the peer of `benchmarks/nonlinear.py`.

`make peers` installs its wheel in .venv/acados, apart from quadsim's packages, and without the CasADi that it carries.
"""

from __future__ import annotations

import contextlib
import ctypes
import io
import os
import shutil
import sys
import tempfile
import time as clock
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from quadsim.mpc.problem.ocp import Problem
from quadsim.mpc.problem.rigidbody import N_BODY, RigidBody
from quadsim.state import Array

FOLDER: Final = Path(sys.prefix) / "acados"
Condensing = Literal["full", "partial"]
KINDS: Final[tuple[Condensing, ...]] = ("full", "partial")
_LOADED_FIRST: Final = ("libblasfeo.so", "libhpipm.so", "libqpOASES_e.so")
_FAILED: Final = (1, 3, 4)  # statuses of acados: not finite, step too short, a QP that failed


def installed() -> bool:
    """Return whether acados, CasADi and what compiles their code are there; acados perhaps in .venv/acados."""
    if FOLDER.is_dir() and str(FOLDER) not in sys.path:
        sys.path.append(str(FOLDER))
    return all(map(shutil.which, ("make", "cc"))) and all(map(find_spec, ("acados", "casadi")))


def _dynamics(model: RigidBody, state: Any, inputs: Any) -> Any:
    """d/dt of position, quaternion, velocity and body rates, undisturbed, as CasADi has it."""
    import casadi

    q, v, w = state[3:7], state[7:10], state[10:13]
    drive = casadi.DM(model.effect) @ inputs  # T [m/s^2], I^-1 tau [rad/s^2]
    J = casadi.DM(model.inertia)
    spin = 0.5 * casadi.vertcat(-casadi.dot(q[1:], w), q[0] * w + casadi.cross(q[1:], w))
    axis = casadi.vertcat(
        2.0 * (q[1] * q[3] + q[0] * q[2]), 2.0 * (q[2] * q[3] - q[0] * q[1]), 1.0 - 2.0 * (q[1] ** 2 + q[2] ** 2)
    )
    acceleration = drive[0] * axis - casadi.DM([0.0, 0.0, model.gravity])
    return casadi.vertcat(v, spin, acceleration, drive[1:] - casadi.cross(w, J * w) / J)


class AcadosRTI:
    """acados' real-time iteration about one state at rest, generated and compiled for a problem.

    Args:
        model: the rigid body, its inputs thrusts without lag or drag.
        problem: costs of the difference of quaternions, and bounds of the inputs.
        rest: (13,) the reference.
        condensing: which of HPIPM's.
        folder: where its code goes.
    """

    def __init__(self, model: RigidBody, problem: Problem, rest: Array, condensing: Condensing, folder: Path) -> None:
        import acados as wheel

        os.environ.update(
            ACADOS_SOURCE_DIR=wheel.DIR,
            ACADOS_PYTHON_INTERFACE_PATH=wheel.TEMPLATE_DIR,
            TERA_PATH=wheel.TERA_PATH,
        )
        sys.path.append(str(Path(wheel.TEMPLATE_DIR).parent))
        for library in _LOADED_FIRST:  # the loader does not look where they are
            ctypes.CDLL(str(Path(wheel.LIB_DIR) / library), ctypes.RTLD_GLOBAL)
        import casadi
        from acados_template import AcadosModel, AcadosOcp, AcadosOcpSolver

        N, nu = problem.horizon, problem.model.nu
        assert not model.actuators
        assert not model.drags
        ocp, described = AcadosOcp(), AcadosModel()
        described.name = f"quadrotor_{condensing}_{N}"
        described.x, described.u = casadi.SX.sym("x", N_BODY), casadi.SX.sym("u", nu)
        described.xdot = casadi.SX.sym("xdot", N_BODY)
        described.f_expl_expr = _dynamics(model, described.x, described.u)
        described.f_impl_expr = described.xdot - described.f_expl_expr
        ocp.model = described
        Q, P, R = problem.objective.weights[0], problem.objective.terminal_weights[0], problem.objective.Q_u
        cost, hover = ocp.cost, problem.model.u_bar
        cost.cost_type = cost.cost_type_e = "LINEAR_LS"
        # acados weighs all nodes but the last by their length.
        cost.W, cost.W_e = np.zeros((N_BODY + nu, N_BODY + nu)), P
        cost.W[:N_BODY, :N_BODY], cost.W[N_BODY:, N_BODY:] = Q / model.step, R / model.step
        cost.Vx, cost.Vu = np.eye(N_BODY + nu, N_BODY), np.eye(N_BODY + nu, nu, -N_BODY)
        cost.Vx_e, cost.yref, cost.yref_e = np.eye(N_BODY), np.concatenate([rest, hover]), rest
        bounds = problem.rows
        at = [bounds.names.index("inputs") + j for j in range(nu)]
        constraints = ocp.constraints
        constraints.lbu, constraints.ubu, constraints.idxbu = bounds.lower[0, at], bounds.upper[0, at], np.arange(nu)
        constraints.x0 = rest
        options = ocp.solver_options
        ocp.dims.N, options.tf = N, N * model.step
        options.qp_solver = f"{condensing.upper()}_CONDENSING_HPIPM"
        options.hessian_approx, options.integrator_type, options.nlp_solver_type = "GAUSS_NEWTON", "ERK", "SQP_RTI"
        options.sim_method_num_stages, options.sim_method_num_steps, options.print_level = 4, 1, 0
        ocp.code_export_directory = str(folder / described.name)
        with contextlib.chdir(folder), contextlib.redirect_stdout(io.StringIO()):
            self._solver = AcadosOcpSolver(ocp, json_file=f"{described.name}.json", verbose=False)
        self._rest, self._hover, self._nodes = rest, hover, N

    def reset(self) -> None:
        """Plan anew from the reference."""
        self._solver.reset()
        for i in range(self._nodes + 1):
            self._solver.set(i, "x", self._rest)
            if i < self._nodes:
                self._solver.set(i, "u", self._hover)

    def step(self, measured: Array) -> tuple[float, Array]:
        """Plan from a measured state (13,); return the processor time of the call [s], and the first input (4,)."""
        for bound in ("lbx", "ubx"):
            self._solver.set(0, bound, measured)
        started = clock.thread_time()
        status = self._solver.solve()
        spent = clock.thread_time() - started
        assert status not in _FAILED, f"acados gives up with status {status}"
        return spent, np.array(self._solver.get(0, "u"))


@contextlib.contextmanager
def acados(model: RigidBody, problem: Problem, rest: Array) -> Iterator[dict[str, AcadosRTI]]:
    """Generate and compile acados' solvers of a problem, in a folder that lasts as long; none where it is missing."""
    kinds = KINDS if installed() else ()
    with tempfile.TemporaryDirectory() as folder:
        yield {f"acados_{kind}": AcadosRTI(model, problem, rest, kind, Path(folder)) for kind in kinds}
