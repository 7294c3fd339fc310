"""The controllers: model predictive control in Python and C, usable without a simulator.

Public names are imported on first use: `quadsim.mpc.LinearMPC`, `quadsim.mpc.paper`, ...  `docs/conventions.md` defines
states, units, frames and margins.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if __name__ == "mpc":  # through the link at the root of a checkout
    raise ImportError("this is quadsim's package of controllers: import quadsim.mpc")

from quadsim import shorthands

if TYPE_CHECKING:
    from quadsim.mpc.forms.condensing import Condensed as Condensed
    from quadsim.mpc.laws.geometric import GeometricController as GeometricController
    from quadsim.mpc.laws.lqr import LQR as LQR
    from quadsim.mpc.laws.nonlinear import Nonlinear as Nonlinear
    from quadsim.mpc.laws.parts.linear import LinearMPC as LinearMPC
    from quadsim.mpc.laws.parts.linear import NominalPreparation as NominalPreparation
    from quadsim.mpc.laws.parts.nonlinear_mpc import NonlinearMPC as NonlinearMPC
    from quadsim.mpc.laws.parts.preparation import RobustPreparation as RobustPreparation
    from quadsim.mpc.laws.pid import CascadedPID as CascadedPID
    from quadsim.mpc.laws.robust import Robust as Robust
    from quadsim.mpc.laws.unconstrained import UnconstrainedMPC as UnconstrainedMPC
    from quadsim.mpc.pilot.pilot import Pilot as Pilot
    from quadsim.mpc.problem.constraints import Bounds as Bounds
    from quadsim.mpc.problem.constraints import Constraint as Constraint
    from quadsim.mpc.problem.constraints import Penalty as Penalty
    from quadsim.mpc.problem.model import LinearModel as LinearModel
    from quadsim.mpc.problem.model import hover_model as hover_model
    from quadsim.mpc.problem.ocp import CondensedQP as CondensedQP
    from quadsim.mpc.problem.ocp import InfeasiblePeriod as InfeasiblePeriod
    from quadsim.mpc.problem.ocp import Objective as Objective
    from quadsim.mpc.problem.ocp import Problem as Problem
    from quadsim.mpc.problem.ocp import Query as Query
    from quadsim.mpc.solvers import QPSolver as QPSolver

_MODULES = {
    "quadsim.mpc.laws.geometric": ("GeometricController",),
    "quadsim.mpc.laws.lqr": ("LQR",),
    "quadsim.mpc.laws.pid": ("CascadedPID",),
    "quadsim.mpc.forms.condensing": ("Condensed",),
    "quadsim.mpc.problem.constraints": ("Bounds", "Constraint", "Penalty"),
    "quadsim.mpc.laws.parts.linear": ("LinearMPC", "NominalPreparation"),
    "quadsim.mpc.problem.model": ("LinearModel", "hover_model"),
    "quadsim.mpc.laws.parts.nonlinear_mpc": ("NonlinearMPC",),
    "quadsim.mpc.laws.nonlinear": ("Nonlinear",),
    "quadsim.mpc.problem.ocp": ("CondensedQP", "Objective", "Problem", "Query", "InfeasiblePeriod"),
    "quadsim.mpc.pilot.pilot": ("Pilot",),
    "quadsim.mpc.laws.parts.preparation": ("RobustPreparation",),
    "quadsim.mpc.laws.robust": ("Robust",),
    "quadsim.mpc.solvers": ("QPSolver",),
    "quadsim.mpc.laws.unconstrained": ("UnconstrainedMPC",),
}
_PUBLIC: dict[str, str] = {}
for _module, _names in _MODULES.items():
    _PUBLIC |= dict.fromkeys(_names, _module)
_SUBPACKAGES = {}
for _name in ("estimate", "export", "forms", "guard", "laws", "pilot", "problem", "solvers", "space", "tables"):
    _SUBPACKAGES[_name] = f"quadsim.mpc.{_name}"
_SUBPACKAGES["paper"] = "quadsim.mpc.problem.paper"
__all__ = [*_PUBLIC, *_SUBPACKAGES]


def __getattr__(name: str) -> Any:
    """Import a public name or a subpackage on first use."""
    if name in _SUBPACKAGES:
        return importlib.import_module(_SUBPACKAGES[name])
    if name not in _PUBLIC:
        raise AttributeError(f"module 'quadsim.mpc' has no attribute {name!r}")
    return globals().setdefault(name, getattr(importlib.import_module(_PUBLIC[name]), name))


shorthands.condensed_form = lambda problem: __getattr__("Condensed").of(problem)
shorthands.nonlinear_mpc = lambda *given, **named: __getattr__("NonlinearMPC")(*given, **named)
shorthands.robust_preparation = lambda *given: __getattr__("RobustPreparation")(*given)


def __dir__() -> list[str]:
    """The public names, imported or not."""
    return sorted({*globals(), *_PUBLIC, *_SUBPACKAGES})
