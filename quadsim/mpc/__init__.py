"""The controllers: model predictive control in numpy, scipy and PIQP, usable without a simulator.

Public names are imported on first use: `mpc.LinearMPC`, `mpc.paper`, ...  `docs/conventions.md` defines states,
units, frames and margins.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mpc.baselines.geometric import GeometricController as GeometricController
    from mpc.baselines.lqr import LQR as LQR
    from mpc.baselines.pid import CascadedPID as CascadedPID
    from mpc.condensing import Condensed as Condensed
    from mpc.condensing import CondensedQP as CondensedQP
    from mpc.constraints import Bounds as Bounds
    from mpc.constraints import Constraint as Constraint
    from mpc.constraints import Penalty as Penalty
    from mpc.linear import LinearMPC as LinearMPC
    from mpc.linear import NominalPreparation as NominalPreparation
    from mpc.model import LinearModel as LinearModel
    from mpc.model import hover_model as hover_model
    from mpc.nonlinear.controller import NonlinearMPC as NonlinearMPC
    from mpc.nonlinear.settings import Nonlinear as Nonlinear
    from mpc.ocp import InfeasiblePeriod as InfeasiblePeriod
    from mpc.ocp import Objective as Objective
    from mpc.ocp import Problem as Problem
    from mpc.ocp import Query as Query
    from mpc.pilot import Pilot as Pilot
    from mpc.robust.controller import RobustPreparation as RobustPreparation
    from mpc.robust.settings import Robust as Robust
    from mpc.solvers import QPSolver as QPSolver
    from mpc.unconstrained import UnconstrainedMPC as UnconstrainedMPC

_MODULES = {
    "mpc.baselines.geometric": ("GeometricController",),
    "mpc.baselines.lqr": ("LQR",),
    "mpc.baselines.pid": ("CascadedPID",),
    "mpc.condensing": ("Condensed", "CondensedQP"),
    "mpc.constraints": ("Bounds", "Constraint", "Penalty"),
    "mpc.linear": ("LinearMPC", "NominalPreparation"),
    "mpc.model": ("LinearModel", "hover_model"),
    "mpc.nonlinear.controller": ("NonlinearMPC",),
    "mpc.nonlinear.settings": ("Nonlinear",),
    "mpc.ocp": ("Objective", "Problem", "Query", "InfeasiblePeriod"),
    "mpc.pilot": ("Pilot",),
    "mpc.robust.controller": ("RobustPreparation",),
    "mpc.robust.settings": ("Robust",),
    "mpc.solvers": ("QPSolver",),
    "mpc.unconstrained": ("UnconstrainedMPC",),
}
_PUBLIC = {name: module for module, names in _MODULES.items() for name in names}
_SUBPACKAGES = ("baselines", "core", "fallback", "nonlinear", "paper", "robust", "solvers")
__all__ = [*_PUBLIC, *_SUBPACKAGES]


def __getattr__(name: str) -> Any:
    """Import a public name or a subpackage on first use."""
    if name in _SUBPACKAGES:
        return importlib.import_module(f"mpc.{name}")
    if name not in _PUBLIC:
        raise AttributeError(f"module 'mpc' has no attribute {name!r}")
    return globals().setdefault(name, getattr(importlib.import_module(_PUBLIC[name]), name))


def __dir__() -> list[str]:
    """The public names, imported or not."""
    return sorted({*globals(), *_PUBLIC, *_SUBPACKAGES})
