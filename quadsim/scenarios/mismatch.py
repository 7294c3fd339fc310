"""What a controller's model lacks of the plant that it flies, where the scenario states both."""

from __future__ import annotations

import numpy as np

from quadsim.controller import ROTORS
from quadsim.mpc.bounded import Weighted, resolved_lag
from quadsim.mpc.model import SHORTEST_LAG
from quadsim.mpc.nonlinear.settings import Nonlinear
from quadsim.mpc.robust.settings import Robust
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.schema.controllers import AnyController
from quadsim.sim.effects.rotors import RotorDynamics
from quadsim.state import Array


def model_notes(assembly: Assembly) -> list[str]:
    """Return a line if the plant's rotors lag and a predictive controller of the scenario predicts none."""
    scenario, rotors = assembly.scenario, assembly.effects.rotors or RotorDynamics()
    lag = rotors.rise or rotors.fall or 0.0
    laws = [scenario.controller, *(spec for _, spec in scenario.controller_changes)]
    ideal = [spec for spec in laws if _predicts_ideal_rotors(spec, assembly)]
    if lag < SHORTEST_LAG or not ideal:
        return []
    remedy = [] if isinstance(ideal[0], Robust | Nonlinear) else ['controller.type = "robust" or "nonlinear"']
    if assembly.vehicle.rotor_rise is None:
        remedy.append(f"vehicle.rotor_rise = {lag:g}")
    remedy.append('controller.rotor_lag = "vehicle"')
    return [
        f"the rotors lag by {1e3 * lag:.4g} ms, and {ideal[0].type} predicts none; to predict it: {', '.join(remedy)}"
    ]


def _predicts_ideal_rotors(spec: AnyController, assembly: Assembly) -> bool:
    if isinstance(spec, Robust):
        return resolved_lag(spec.rotor_lag, assembly.vehicle) == 0.0
    if isinstance(spec, Nonlinear):  # an autopilot's lags include that of its rotors
        return spec.commands == ROTORS and resolved_lag(spec.rotor_lag, assembly.vehicle) == 0.0
    return isinstance(spec, Weighted)


def course_headings(assembly: Assembly) -> Array:
    """Return the course's headings at the control instants of the flight (K,), without its filter [rad]."""
    scenario = assembly.scenario
    t = scenario.control_period * np.arange(scenario.periods + 1, dtype=np.float64)
    return assembly.course.sample(t)[:, 3]
