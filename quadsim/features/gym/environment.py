"""A scenario as a Gymnasium environment: plant, sensors, wind and audit as in `quadsim run`, with an agent in the loop.

A step is one control period: an action becomes a command (`spaces.py`), the loop of `quadsim.rollout` flies it, and the
observation, the reward (`rewards.py`) and the margins follow.  `episodes.py` draws what an episode flies; many
environments at once are `vector.py`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ClosedEnvironmentError, ResetNeeded

from quadsim.controller import Command, Phase, StepInputs
from quadsim.errors import FlightError, ParameterError
from quadsim.features.gym.episodes import Episode, Episodes, Variation
from quadsim.features.gym.rewards import Reward, RewardHook, nearness
from quadsim.features.gym.spaces import USUAL, Action, Actions, Observations
from quadsim.report.film.camera import Camera
from quadsim.rollout.flown import Flight
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.sim.margins import Margins, violated
from quadsim.sim.physics import Observation, Period
from quadsim.state import INDEX, Array


class QuadrotorEnv(gymnasium.Env):  # type: ignore[misc]
    """A scenario, one step per control period.

    For observations and actions see `quadsim.features.gym.spaces`.  An episode is terminated when the vehicle is lost
    by a criterion of `[lost]`, has crashed, or has diverged, and truncated at the scenario's duration, which a
    campaign's `[set]` may change.

    A pickled or copied environment has no episode, as the plant of one is native memory: reset it first.

    `info` at each step, and at the start:

    - `margins`: worst signed margin of each constraint within the step, in the constraint's unit; negative = beyond the
      bound, inf outside its time window.  It is taken at the physics rate, or at the control rate where the signal has
      no other samples (tracking errors, `slew`).
    - `margins_sampled`: the margins at the end of the step, as a check at the control rate has them.
    - `constraint_values`: (m,) g = -margin in the order of `constraint_names`, so that satisfied means g <= 0.
    - `constraint_violation`: 1 where a required constraint was violated beyond its tolerances, else 0.
    - `cost`: number of required constraints violated.
    - `time` [s], `phase` (`flying`, `landed`, ...), `reason` (why the flight ended; empty until then).
    - `seed` of the episode; where something varies also `flight`, its number in the campaign, and `draw`, the values
      drawn by the names of the campaign's entries.

    Attributes:
        scenario: the scenario of this episode.
        limits: the limits of its audit.
        actions: what an action means.
        observations: what an observation has, with the unit of each entry.
        preview: observed periods of the reference.
        episodes: what draws the episodes.
        violated: (m,) which required constraints the last step violated beyond their tolerances.

    Examples:
        >>> import numpy as np
        >>> import quadsim.gym
        >>> env = quadsim.gym.QuadrotorEnv("hover", observation=("state",))
        >>> observation, info = env.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = env.step(np.full(4, 0.1, np.float32))
        >>> observation.shape, terminated, info["margins"]["roll"]
        ((12,), False, 5.0)
        >>> env.close()
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012  as Gymnasium has it

    def __init__(
        self,
        scenario: Scenario | str | Path | Episodes,
        *,
        action: str = "deviations",
        observation: Sequence[str] = USUAL,
        preview: int | None = None,
        vary: Variation | None = None,
        reward: Reward = nearness,
        render_mode: str | None = None,
        width: int = 640,
        height: int = 480,
    ) -> None:
        """Set up; nothing is flown before `reset`.

        Args:
            scenario: the scenario, or its name or file.
            action: what an action means: `deviations` from hover, also called `rotors`, rotor `speeds` [rad/s], rotors'
                `thrust`, or collective thrust and `rates` or `attitude`; see `quadsim.features.gym.spaces.Actions`.
            observation: parts, of `state`, `preview`, `ahead` and `command`.
            preview: observed periods of the reference, at most the controller's horizon (default).
            vary: a campaign, its name or file, whose `[set]` changes the scenario and whose `[[vary]]` is drawn anew
                at each reset; or a list of such entries.
            reward: reward of a step; see `Reward`.
            render_mode: `rgb_array` or None; `human` by the wrapper that `gymnasium.make` adds, with pygame.
            width: width of pictures [pixels].
            height: height of pictures [pixels].

        Raises:
            InputError: an argument is not allowed.
        """
        if isinstance(scenario, Episodes):
            self.episodes = scenario
        else:
            self.episodes = Episodes(scenario, vary)
        self._base = self.episodes.base
        if render_mode not in (None, "rgb_array"):
            raise ParameterError("", "render_mode", render_mode, "rgb_array or None")
        self.preview = _observed_periods(preview, self._base.controller.horizon)
        self.metadata = {**self.metadata, "render_fps": max(1, round(1.0 / self._base.control_period))}
        self.observations = Observations(observation, self.preview)
        self.actions = Actions(action, self._base, Assembly(self._base).vehicle)
        self.action_space = self.actions.space
        self.observation_space = self.observations.space
        self.render_mode = render_mode
        self._size = (width, height)
        self._reward = RewardHook(reward)
        self._action = action
        self._flight: Rollout | None = None
        self._camera: Camera | None = None
        self._closed = False
        self.scenario = self._base
        self.limits = self.episodes.assembly(self._base).limits

    @property
    def constraint_names(self) -> tuple[str, ...]:
        """The names of `limits`, in the order of `constraint_values`."""
        return tuple(limit.name for limit in self.limits)

    @property
    def outcome(self) -> tuple[Array, Array, Array]:
        """The arguments of the last step's reward: true state (12,), reference (4,), commanded speeds (4,) [rad/s]."""
        acting = self._seen.moment.acting
        assert acting is not None
        return self._truth, self._seen.reference, acting

    @property
    def started(self) -> Rollout:
        """The flight of this episode.

        Raises:
            ResetNeeded: there is none yet.
        """
        if self._flight is None:
            raise ResetNeeded("call env.reset() first; a pickled or copied environment is without its episode")
        return self._flight

    def require_open(self) -> None:
        """Raise `gymnasium.error.ClosedEnvironmentError` after `close`."""
        if self._closed:
            raise ClosedEnvironmentError("the environment is closed; make a new one")

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what is native memory or a process: the episode and the renderer."""
        return {**self.__dict__, "_flight": None, "_camera": None, "_substitute": None}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: the scenario's, as of `quadsim run --seed`.  Without one the first episode has the scenario's own, and
                the seeds of later ones are drawn from the last that was given.  With `vary`, the flight of the campaign
                is drawn from it.
            options: `flight`, the number of a flight of the campaign that varies something.

        Raises:
            InputError: the seed or an option is not allowed.
            ClosedEnvironmentError: `close` has been called.
        """
        self.require_open()
        if seed is not None:
            self.episodes.check_seed(seed)
        elif self._flight is None:
            seed = self._base.seed
        super().reset(seed=seed)
        return self.start(self.episodes.draw(seed, options or {}, self.np_random))

    def replay(self, episode: Episode, actions: Iterable[Action]) -> Flight:
        """Fly an episode by these actions until they, or the episode, end; return its flight.

        Raises:
            ClosedEnvironmentError: `close` has been called.
        """
        self.require_open()
        self.start(episode)
        for action in actions:
            if self._over:
                break
            self.step(action)
        return self.flight()

    def start(self, episode: Episode) -> tuple[Array, dict[str, Any]]:
        """Start an episode that has been drawn; see `reset`."""
        scenario = episode.scenario
        if self._flight is not None:
            self._flight.close()
        self.scenario = scenario
        self._episode = episode
        assembly = self.episodes.assembly(scenario)
        if self.episodes.varied:
            self.actions = Actions(self._action, scenario, assembly.vehicle)
        controller: Any = Agent(scenario.controller.horizon)
        if scenario.controller_changes:  # events that change the controller need the scenario's own
            controller = None
        self._flight = Rollout(assembly, controller)
        self.limits = self._flight.limits
        self._margins = Margins(self.limits, scenario.plant.timestep)
        self._substitute: tuple[int, Action, Command] | None = None  # period, action, and what it flies
        self._seen = self._flight.observation
        self._truth = self._seen.truth
        self._over = False
        loop = self._flight.loop
        worst, sampled = self._margins.of_start(loop.physics, loop.rotors)
        return self._vector(self._seen), self._info(worst, sampled)

    def step(self, action: Action) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Fly one control period.

        An action that is NaN ends the flight, as a controller's would.

        Raises:
            ParameterError: the action has another shape than `action_space`, is not of numbers, or is outside of it.
            ResetNeeded: there is no episode, or it has ended.
            ClosedEnvironmentError: `close` has been called.
        """
        self.require_open()
        flight = self.started
        if self._over:
            raise ResetNeeded(f"the episode has ended ({flight.loop.reason or 'the scenario is over'}); call reset()")
        seen = self._seen
        command = self._command(action)
        try:
            sample = flight.loop.step(command)
        except FlightError:
            self._over = True
            unlimited = np.full(len(self.limits), np.inf)
            return self._vector(seen), 0.0, True, False, self._info(unlimited, unlimited)
        self._observe(sample)
        terminated = flight.loop.reason is not None or self._seen.moment.phase is Phase.CRASHED
        worst, sampled = self._margins.of_period(sample)
        info = self._info(worst, sampled)
        reward = self._reward.of_one(*self.outcome, info["margins"])
        self._over = flight.done
        truncated = self._over and not terminated
        return self._vector(self._seen), reward, terminated, truncated, info

    def _observe(self, sample: Period) -> None:
        """Observe the vehicle after a period [k, k + 1]; one that is lost is not measured, and has its true state."""
        loop = self.started.loop
        try:
            self._seen = loop.observation
            self._truth = self._seen.truth
        except FlightError:  # lost: a controller would not be called again
            self._truth = loop.truth
            rows = loop.followed(float(self._truth[INDEX["yaw"]]))
            moment = replace(self._seen.moment, acting=sample.speeds)
            self._seen = replace(self._seen, state=self._truth, reference=rows[0], preview=rows[1:], moment=moment)

    def _command(self, action: Action) -> Command:
        """Return the command of an action, or the one that `fly_instead` has set for it in this period."""
        flight = self.started
        if self._substitute is not None:
            period, replaced, command = self._substitute
            if period == flight.k and np.array_equal(replaced, action):
                return command
        yaw = float(self._seen.state[INDEX["yaw"]])
        return self.actions.command(action, flight.loop.controller.horizon, yaw)

    def controller_action(self) -> Action:
        """Return the action equivalent to the command of the scenario's controller now; it is computed once per period.

        If `step` is given exactly this action next, it flies the controller's command itself, with its plan and status:
        an episode of such actions is the flight of `quadsim run`, bit for bit.

        Raises:
            ParameterError: actions are targets of an autopilot, to which rotor speeds are not converted.
            FlightError: the controller has no command; a flight of `quadsim run` would end here.
            ClosedEnvironmentError: `close` has been called.
        """
        self.require_open()
        flight = self.started
        if self._substitute is not None:
            period, action, _ = self._substitute
            if period == flight.k:
                return action
        self.actions.of(np.zeros(4))  # raises if actions have no equivalent rotor speeds, before anything is computed
        agent = flight.loop.controller
        if isinstance(agent, Agent):
            flight.loop.controller = Assembly(self.scenario).controller()
            flight.loop.controller.reset(agent.speeds)
        seen = self._seen
        command = flight.loop.controller.step(seen.moment, seen.state, seen.preview)
        return self.action_for(command)

    def action_for(self, command: Command) -> Action:
        """Return the action equivalent to a command; taken next, it flies that command with its plan and status.

        Raises:
            ParameterError: actions are targets of an autopilot.
        """
        low = self.action_space.low
        high = self.action_space.high
        action = np.clip(self.actions.of(command.speeds), low, high)
        self.fly_instead(action, command)
        return action

    def fly_instead(self, action: Action, command: Command) -> None:
        """Set the command of rotor speeds that `step` flies, with its plan and status, if its action is this one."""
        self._substitute = (self.started.k, action, command)

    def flight(self) -> Flight:
        """Return the episode so far as an audited flight, which can be saved and plotted.

        Its `save` also films it, which may take minutes; `save(directory, video=False)` does without the film.
        """
        controller = self.started.loop.controller
        return replace(self.started.flight(), controller=controller.name, solver=controller.solver)

    def render(self) -> np.ndarray[Any, np.dtype[np.uint8]] | None:
        """Return the picture (height, width, 3), rendered by a separate process; None without a render mode.

        Raises:
            RenderingUnavailableError: nothing can render here.
            ClosedEnvironmentError: `close` has been called.
        """
        self.require_open()
        if self.render_mode is None:
            return None
        if self._camera is None:
            width, height = self._size
            self._camera = Camera(self.started.actual, self.scenario.obstacles, width=width, height=height)
        loop = self.started.loop
        return self._camera.picture(self._truth, loop.rotors, self._seen.reference, loop.time)

    def close(self) -> None:
        """Free native memory and the renderer; only `flight` remains."""
        self._closed = True
        if self._flight is not None:
            self._flight.close()
        if self._camera is not None:
            self._camera.close()
            self._camera = None

    def _vector(self, seen: Observation) -> Array:
        """Return the observation; a reference that ends earlier than the preview keeps its last value."""
        rows = seen.preview
        acting = seen.moment.acting
        assert acting is not None
        if len(rows) < self.preview:
            last = rows[-1:]
            if not len(rows):
                last = seen.reference[None]
            rows = np.concatenate([rows, np.repeat(last, self.preview - len(rows), axis=0)])
        return self.observations.of(seen.state, rows[: self.preview], acting)

    def _info(self, worst: Array, sampled: Array) -> dict[str, Any]:
        """Return `info` of the margins (m,) within the step and at its end."""
        self.violated = violated(self._margins.tolerances, self._margins.required, worst, sampled)
        loop = self.started.loop
        names = self.constraint_names
        return {
            "margins": dict(zip(names, worst.tolist(), strict=True)),
            "margins_sampled": dict(zip(names, sampled.tolist(), strict=True)),
            "constraint_values": -worst,
            "constraint_violation": int(self.violated.any()),
            "cost": float(self.violated.sum()),
            "time": loop.time,
            "phase": str(self._seen.moment.phase),
            "reason": loop.reason or "",
            **self._episode.info,
        }


class Agent:
    """Takes the controller's place while actions fly; `controller_action` builds the scenario's when first needed."""

    name = "agent"
    solver = ""

    def __init__(self, horizon: int) -> None:
        self.horizon = horizon

    def reset(self, speeds: Array) -> None:
        """See `quadsim.controller.Controller.reset`."""
        self.speeds = speeds.copy()

    def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
        """Never called: each step has a command."""
        raise NotImplementedError


def _observed_periods(preview: int | None, horizon: int) -> int:
    """Return the observed periods of the reference, by default the controller's horizon."""
    if preview is None:
        return horizon
    if not (isinstance(preview, int | np.integer) and 1 <= preview <= horizon):
        raise ParameterError("", "preview", preview, f"from 1 to controller.horizon = {horizon} periods")
    return preview
