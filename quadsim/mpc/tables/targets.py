"""What the tables of MPCs share that command rotors, or the thrust and body rates that an autopilot flies.

Attitudes, where they are commanded, are made of the body rates that the MPC asks for
(`quadsim.mpc.pilot.attitudes`).
"""

from __future__ import annotations

from quadsim.controller import ATTITUDE, ROTORS
from quadsim.mpc.pilot.attitudes import AttitudeTargets
from quadsim.mpc.problem.model import LinearModel, hover_model, target_model
from quadsim.mpc.tables.controller import ControllerTable
from quadsim.mpc.tables.lags import require_attitude_lag, require_lags
from quadsim.vehicle import Vehicle


class TargetTable(ControllerTable):
    """A table whose controller commands rotors, or body rates and thrust through an autopilot."""

    @property
    def turns_by_attitude(self) -> bool:
        """See `quadsim.mpc.tables.controller.ControllerTable.turns_by_attitude`."""
        return self.commands == ATTITUDE

    def attitudes(self) -> AttitudeTargets | None:
        """See `quadsim.mpc.tables.controller.ControllerTable.attitudes`."""
        if not self.turns_by_attitude:
            return None
        return AttitudeTargets(require_attitude_lag(self.attitude_lag))

    def level_hover(self, vehicle: Vehicle, period: float) -> LinearModel:
        """See `quadsim.mpc.tables.controller.ControllerTable.level_hover`."""
        if self.commands == ROTORS:
            return hover_model(vehicle, period)
        return target_model(vehicle, period, require_lags(self.inner_lag), self.attitude_lag)

    def _require_polytopes_without_speeds(self) -> None:
        """Refuse polytopes of rotor speeds where an autopilot flies, which decides these.

        Raises:
            ValueError: there is one.
        """
        if self.commands == ROTORS:
            return
        of_speeds = []
        for polytope in self.polytopes:
            if any("speed_" in name for name in polytope.of):
                of_speeds.append(polytope.name)
        if of_speeds:
            rule = f'without rotor speeds where commands = "{self.commands}"'
            raise ValueError(f"polytopes must be {rule}; got {of_speeds}")
