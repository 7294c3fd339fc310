"""A problem of tests/peers/casadi_ocp.py by acados: generated C, one real-time iteration per call.

acados comes from `comma-deps-acados`, which brings libraries, templates and a CasADi of its own.  Installed beside the
peers' CasADi it would overwrite that, so it lies in a directory of its own, the last on the path.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import os
import sys
from pathlib import Path
from typing import Any, Final

import casadi as cs
import numpy as np
from peers.casadi_ocp import Case, following

from quadsim.state import Array

LIBRARIES: Final = ("libblasfeo.so", "libhpipm.so", "libqpOASES_e.so.3.1", "libacados.so")
"""In the order of what needs what: the wheel's do not find one another."""


class AcadosRTI:
    """A case with linear least squares and bounds on inputs alone, by SQP_RTI with exact discrete dynamics.

    Args:
        case: with `difference`, and without weight or bounds on moves and tilt.
        directory: where comma-deps-acados is installed.
        scratch: where its C code goes, and is compiled by make and a C compiler.
        solver: of the QP, by acados' name.

    Raises:
        ValueError: the case has what is not built here.
    """

    def __init__(self, case: Case, directory: Path, scratch: Path, solver: str = "PARTIAL_CONDENSING_HPIPM") -> None:
        if not case.difference or case.move or case.tilt or case.steps:
            raise ValueError(f"{case.name}: more than linear least squares and bounds on inputs")
        self._case = case
        template = _templates(directory)
        ocp, n, N = template.AcadosOcp(), case.n, case.nodes
        ocp.model = model = template.AcadosModel()
        model.name, model.x, model.u = f"quadrotor_{n}", cs.SX.sym("x", n), cs.SX.sym("u", 4)
        model.disc_dyn_expr = following(case, model.x, model.u)
        ocp.dims.N = N
        body = [case.position] * 3 + [case.attitude] * 4 + [case.velocity] * 3 + [case.body_rates] * 3
        ocp.cost.cost_type = ocp.cost.cost_type_e = "LINEAR_LS"
        ocp.cost.W = np.diag(body + [case.input] * 4)
        ocp.cost.Vx = np.vstack([np.eye(13, n), np.zeros((4, n))])
        ocp.cost.Vu = np.vstack([np.zeros((13, 4)), np.eye(4)])
        ocp.cost.W_e, ocp.cost.Vx_e = np.zeros((13, 13)), np.eye(13, n)
        ocp.cost.yref, ocp.cost.yref_e = np.zeros(17), np.zeros(13)
        ocp.constraints.lbu, ocp.constraints.ubu, ocp.constraints.idxbu = np.zeros(4), np.ones(4), np.arange(4)
        ocp.constraints.x0 = np.zeros(n)
        options = ocp.solver_options
        options.tf, options.integrator_type = N * case.node, "DISCRETE"
        options.nlp_solver_type, options.hessian_approx, options.qp_solver = "SQP_RTI", "GAUSS_NEWTON", solver
        options.qp_tol = 1e-8
        ocp.code_export_directory = str(scratch / model.name)
        with contextlib.redirect_stdout(None):
            self._solver = template.AcadosOcpSolver(ocp, json_file=str(scratch / f"{model.name}.json"), verbose=False)

    def start(self, states: Array, inputs: Array) -> None:
        """Linearise along states (N + 1, n) and inputs (N, 4) next."""
        for i, x in enumerate(states):
            self._solver.set(i, "x", x)
        for i, u in enumerate(inputs):
            self._solver.set(i, "u", u)

    def step(self, x0: Array, states: Array, inputs: Array) -> tuple[int, Array]:
        """Status and first input (4,) at a state (n,), towards states (N + 1, 13) and inputs (N, 4)."""
        solver = self._solver
        for i, wanted in enumerate(np.hstack([states[:-1], inputs])):
            solver.set(i, "yref", wanted)
        solver.set(0, "lbx", x0)
        solver.set(0, "ubx", x0)
        return solver.solve(), solver.get(0, "u")


def _templates(directory: Path) -> Any:
    """The package `acados_template`, set up."""
    if str(directory) not in sys.path:
        sys.path.append(str(directory))
    acados = importlib.import_module("acados")
    for name in LIBRARIES:
        ctypes.CDLL(str(Path(acados.LIB_DIR) / name), mode=ctypes.RTLD_GLOBAL)
    os.environ["ACADOS_SOURCE_DIR"], os.environ["TERA_PATH"] = acados.DIR, acados.TERA_PATH
    os.environ["ACADOS_PYTHON_INTERFACE_PATH"] = acados.TEMPLATE_DIR
    with contextlib.redirect_stdout(None):
        return importlib.import_module("acados.acados_template")
