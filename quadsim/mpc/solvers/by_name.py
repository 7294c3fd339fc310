"""The solver of a problem by name, the compiled core included."""

from __future__ import annotations

from quadsim.controller import CORE
from quadsim.errors import ParameterError
from quadsim.mpc.problem.ocp import Problem
from quadsim.mpc.solvers import QPSolver, Solver


def make_solver(name: str, problem: Problem) -> Solver:
    """Return a problem's solver by name: the core, or a QP solver that first tries the unconstrained optimum.

    Raises:
        UnknownNameError, MissingPackageError: the solver does not exist, or is not installed.
        ParameterError: the core cannot take the problem.
    """
    if name != CORE:
        return QPSolver(name, problem, free_first=True)
    from quadsim.mpc.solvers.core import Core  # late: the folder `core` imports `solvers`

    try:
        return Core(problem)
    except ParameterError as error:
        rule = f"a QP solver such as 'piqp' for this problem: {error}"
        raise ParameterError("controller", "solver", CORE, rule) from None
