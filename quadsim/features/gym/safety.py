"""MPC as a safety filter: it passes actions after which the robust MPC's constraints remain feasible.

The command is the nearest to the requested rotor speeds, min |u - u_requested|^2, from which a plan within the robust
MPC's constraints exists (`quadsim.mpc.laws.parts.safety_filter`).  It wraps an environment of `environment.py`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded

from quadsim.controller import ROTORS, UNCONSTRAINED
from quadsim.errors import ParameterError
from quadsim.features.gym.environment import QuadrotorEnv
from quadsim.features.gym.spaces import Action
from quadsim.mpc.laws.parts.safety_filter import safety_filter
from quadsim.mpc.laws.robust import Robust
from quadsim.mpc.pilot.pilot import Pilot
from quadsim.rotation import euler_to_body_rates
from quadsim.sim.physics import Observation
from quadsim.state import ANGLE_RATES, ANGLES, Array
from quadsim.vehicle import Vehicle


class MPCSafetyFilter(gymnasium.Wrapper):  # type: ignore[misc]
    """Passes an action, or the nearest one after which the constraints can be satisfied.

    See `quadsim.mpc.laws.parts.safety_filter`.

    An action that is not finite is never flown: the fallback's command is, until the next one.

    Actions `rates` are filtered as the rotor speeds that give their thrust and, at the end of the period, the body
    rates at which their rate loop arrives (`quadsim.features.gym.spaces.Actions.held_speeds`).  Behind the filter
    these speeds are held, whether they pass or are changed, so that what flies is what the filter has checked.

    `info["filter"]` at each step: `intervened`, `correction` (by how much it changed any rotor's speed at most
    [rad/s]), and `fallback` (0 while its QP had an answer; see `quadsim.controller.Command`).  The episode's flight has
    the status `unconstrained` in periods whose action passed.

    Attributes:
        steps: steps of this episode.
        interventions: in how many of them it stepped in.

    Examples:
        >>> import numpy as np
        >>> import quadsim.gym
        >>> env = quadsim.gym.MPCSafetyFilter(quadsim.gym.make_env("robust", action="speeds"))
        >>> observation, info = env.reset(seed=0)
        >>> for _ in range(20):
        ...     observation, reward, terminated, truncated, info = env.step(np.array([250.0, 0.0, 0.0, 250.0]))
        >>> env.interventions, info["margins"]["pitch"] > 0.0, terminated
        (20, True, False)
        >>> env.close()
    """

    def __init__(self, env: gymnasium.Env[Any, Any], controller: Mapping[str, Any] | None = None) -> None:
        """Wrap an environment.

        Args:
            env: of `quadsim.gym`.
            controller: the table of a robust MPC, as in a scenario file; the scenario's own where absent.

        Raises:
            InputError: the environment is another, or the controller is none that can filter.
        """
        super().__init__(env)
        base = env.unwrapped
        if not isinstance(base, QuadrotorEnv):
            raise ParameterError("", "env", type(base).__name__, "an environment of quadsim.gym")
        base.actions.require_held()
        scenario = base.scenario
        if controller is not None:
            scenario = scenario.replace({"controller": dict(controller)})
        if not isinstance(scenario.controller, Robust):
            raise ParameterError("controller", "type", scenario.controller.type, "robust, for a safety filter")
        if scenario.controller.commands != ROTORS:
            raise ParameterError("controller", "commands", scenario.controller.commands, "rotors, for a safety filter")
        self._base = base
        self._spec = scenario.controller
        self._vehicle: Vehicle | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the controller, which is native memory; the environment leaves out its episode."""
        kept = dict(self.__dict__)
        kept.pop("_filter", None)
        kept.pop("_pilot", None)
        kept["_vehicle"] = None
        return kept

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """See `gymnasium.Env.reset`."""
        observed = self.env.reset(seed=seed, options=options)
        started = self._base.started
        if started.vehicle != self._vehicle:
            vehicle = started.vehicle
            period = started.scenario.control_period
            self._filter = safety_filter(self._spec, vehicle, period)
            self._pilot = Pilot(self._filter, vehicle, guard=self._spec.guard(vehicle, period))
            self._vehicle = vehicle
        acting = started.observation.moment.acting
        assert acting is not None
        self._pilot.reset(acting)
        self.steps = 0
        self.interventions = 0
        return observed

    def step(self, action: Action) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """See `gymnasium.Env.step`.

        Raises:
            ParameterError: the action has another shape than `action_space`, or is not of numbers.
            ResetNeeded: there is no episode, or it has ended.
            ClosedEnvironmentError: `close` has been called.
        """
        if self._vehicle is None:
            raise ResetNeeded("call env.reset() first; a pickled or copied environment is without its episode")
        self._base.require_open()
        seen = self._base.started.observation
        requested = self._base.actions.held_speeds(action, _body_rates(seen))
        self._filter.requested = requested
        horizon = self._pilot.horizon
        preview = seen.preview[:horizon]
        preview = np.concatenate([preview, np.repeat(preview[-1:], horizon - len(preview), axis=0)])
        command = self._pilot.step(seen.moment, seen.state, preview)
        correction = float(np.abs(command.speeds - requested).max())
        intervened = command.status != UNCONSTRAINED
        self.steps += 1
        self.interventions += intervened
        space = self._base.action_space
        finite = np.nan_to_num(np.asarray(action, space.dtype))
        within = np.clip(finite, space.low, space.high)
        self._base.fly_instead(within, command)
        observed, reward, terminated, truncated, info = self.env.step(within)
        report = {"intervened": intervened, "correction": correction, "fallback": command.fallback}
        return observed, reward, terminated, truncated, {**info, "filter": report}


def _body_rates(seen: Observation) -> Array:
    """Return the body rates (3,) [rad/s] that a controller is given, or those of the state."""
    if seen.moment.body_rates is not None:
        return seen.moment.body_rates
    return euler_to_body_rates(seen.state[ANGLES], seen.state[ANGLE_RATES])
