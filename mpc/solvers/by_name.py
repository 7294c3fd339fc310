"""The solver of a problem by name, the compiled core included."""

from __future__ import annotations

from mpc.ocp import Problem
from mpc.solvers import CORE_OR_PIQP, QPSolver, Solver
from quadsim.controller import CORE
from quadsim.errors import InputError, MissingCoreError, ParameterError


def make_solver(name: str, problem: Problem) -> Solver:
    """Return a problem's solver by name: the core, or a QP solver that first tries the unconstrained optimum.

    Raises:
        UnknownNameError, MissingPackageError, MissingCoreError: the solver does not exist, or is not installed.
        ParameterError: the core cannot take the problem.
    """
    if name not in (CORE, CORE_OR_PIQP):
        return QPSolver(name, problem, free_first=True)
    from mpc.core.solver import Core  # late: the folder `core` imports `solvers`

    try:
        return Core(problem)
    except InputError as error:
        if name == CORE_OR_PIQP:
            return make_solver("piqp", problem)
        if isinstance(error, MissingCoreError):
            raise
        rule = f"a QP solver such as 'piqp' for this problem: {error}"
        raise ParameterError("controller", "solver", CORE, rule) from error
