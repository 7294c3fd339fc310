"""Scenarios as Gymnasium environments: the plant, sensors, air and audit of `quadsim run`, an agent in the loop."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from gymnasium.vector import VectorEnv

from quadsim.controller import Command, Phase, StepInputs
from quadsim.errors import FlightError, ParameterError
from quadsim.features.entries import commands_of
from quadsim.features.gym.spaces import USUAL, Action, Actions, Observations
from quadsim.flight.audit import Limit
from quadsim.flight.log import FlightLog, PeriodLog
from quadsim.report.film.camera import Camera
from quadsim.rollout.flown import Flight
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.assembly import Assembly, preferring_core
from quadsim.scenarios.catalogue import scenario_names
from quadsim.scenarios.loading import load_scenario
from quadsim.scenarios.schema.base import LARGEST_WHOLE
from quadsim.scenarios.schema.bases import read_scenario
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.sim.physics import Observation, one_period
from quadsim.state import REFERENCE_STATES, Array, wrapped

Reward = Callable[[Array, Array, Array], float]
"""Function of the true state (12,) after a step, the reference (4,) and the commanded rotor speeds (4,) [rad/s]."""


def nearness(state: Array, reference: Array, speeds: Array) -> float:
    """Default reward, exp(-d) in (0, 1], with d the distance from the reference [m] plus the yaw error [rad].

    It is never negative, so ending an episode early never pays.
    """
    error = state[list(REFERENCE_STATES)] - reference
    return math.exp(-math.hypot(*error[:3].tolist()) - abs(wrapped(float(error[3]))))


class QuadrotorEnv(gymnasium.Env):  # type: ignore[misc]
    """A scenario, one step per control period.

    For observations and actions see `quadsim.features.gym.spaces`.  An episode is terminated when the vehicle is lost
    by a criterion of `[lost]`, has crashed, or has diverged, and truncated at the scenario's duration, which a
    campaign's `[set]` may change.

    A pickled or copied environment is without its episode, whose plant is native memory: reset it first.

    `info` at each step, and at the start:

    - `margins`: signed margin of each constraint at its worst within the step, at the physics rate, or at the samples
      where its signal has no others (tracking errors, `slew`), in the constraint's unit; negative = beyond the bound,
      inf outside its time window.
    - `margins_sampled`: the margins at the end of the step, as a check at the control rate sees them.
    - `constraint_values`: (m,) g = -margin in the order of `constraint_names`, so that g <= 0 holds; -inf outside.
    - `constraint_violation`: 1 where a required constraint was violated beyond its tolerances, else 0.
    - `cost`: number of required constraints violated.
    - `time` [s], `phase` (`flying`, `landed`, ...), `reason` (why the flight ended; empty until then).

    Attributes:
        scenario: the scenario of this episode.
        limits: the limits of its audit.
        actions: what an action means.
        observations: what an observation has, with the unit of each entry.

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
        scenario: Scenario | str | Path,
        *,
        action: str = "deviations",
        observation: Sequence[str] = USUAL,
        preview: int | None = None,
        vary: str | Path | None = None,
        reward: Reward = nearness,
        render_mode: str | None = None,
        width: int = 640,
        height: int = 480,
    ) -> None:
        """Set up; nothing is flown before `reset`.

        Args:
            scenario: the scenario, or its name or file.
            action: `deviations` from hover, rotor `speeds` [rad/s], or collective thrust and body `rates`.
            observation: parts, of `state`, `preview`, `ahead` and `command`.
            preview: observed periods of the reference, at most the controller's horizon (default).
            vary: a campaign, its name or file, whose `[set]` changes the scenario and whose `[[vary]]` is drawn anew
                at each reset.
            reward: reward of a step; see `Reward`.
            render_mode: `rgb_array` or None; `human` by the wrapper that `gymnasium.make` adds, with pygame.
            width: width of pictures [pixels].
            height: height of pictures [pixels].

        Raises:
            InputError: an argument is not allowed.
        """
        scenario = preferring_core(load_scenario(scenario))
        self._plan = None if vary is None else commands_of("campaign").drawn_flights(scenario, str(vary))
        self._base = scenario if self._plan is None else self._plan.scenario
        if render_mode not in (None, "rgb_array"):
            raise ParameterError("", "render_mode", render_mode, "rgb_array or None")
        horizon = self._base.controller.horizon
        preview = horizon if preview is None else preview
        if not 1 <= preview <= horizon:
            raise ParameterError("", "preview", preview, f"from 1 to controller.horizon = {horizon} periods")
        self.metadata = {**self.metadata, "render_fps": max(1, round(1.0 / self._base.control_period))}
        self.observations = Observations(observation, preview)
        self.actions = Actions(action, self._base, Assembly(self._base).vehicle)
        self.action_space, self.observation_space = self.actions.space, self.observations.space
        self.render_mode, self._size = render_mode, (width, height)
        self._preview, self._reward, self._action = preview, reward, action
        self._flight: Rollout | None = None
        self._camera: Camera | None = None
        self._closed = False
        self.scenario = self._base
        self.limits = self._assembly(self._base).limits

    @property
    def constraint_names(self) -> tuple[str, ...]:
        """The names of `limits`, in the order of `constraint_values`."""
        return tuple(limit.name for limit in self.limits)

    @property
    def started(self) -> Rollout:
        """The flight of this episode.

        Raises:
            ResetNeeded: there is none yet.
        """
        if self._flight is None:
            raise ResetNeeded("call env.reset() first; a pickled or copied environment is without its episode")
        return self._flight

    def _require_open(self) -> None:
        if self._closed:
            raise ClosedEnvironmentError("the environment is closed; make a new one")

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what is native memory or a process: the episode and the renderer."""
        return {**self.__dict__, "_flight": None, "_camera": None, "_answered": None}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: the scenario's, as of `quadsim run --seed`.  Without one the first episode has the scenario's own, and
                each further one a seed drawn from the last that was given.  Where something varies, it is what the
                campaign's flight is drawn from.
            options: `flight`, the number of a flight of the campaign that varies something.

        Raises:
            InputError: the seed or an option is not allowed.
            ClosedEnvironmentError: `close` has been called.
        """
        self._require_open()
        if seed is not None and not (isinstance(seed, int | np.integer) and 0 <= seed <= LARGEST_WHOLE):
            raise ParameterError("", "seed", seed, f"from 0 to {LARGEST_WHOLE}")
        if seed is None and self._flight is None:
            seed = self._base.seed
        super().reset(seed=seed)
        scenario = self._drawn(seed, options or {})
        if self._flight is not None:
            self._flight.close()
        self.scenario = scenario
        if self._plan is not None:
            self.actions = Actions(self._action, scenario, Assembly(scenario).vehicle)
        # events that change the controller need a real one
        law: Any = None if scenario.controller_changes else Agent(scenario.controller.horizon)
        self._flight = Rollout(self._assembly(scenario), law)
        self.limits = self._flight.limits
        self._answered: tuple[int, Action, Command] | None = None  # in which period, by the controller
        self._seen, log = self._flight.observation, self._flight.loop.log()
        self._truth, self._rotors = log.plant.state[-1], log.plant.speeds[-1]
        return self._vector(self._seen), self._info(*_margins(self.limits, log))

    def step(self, action: Action) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Fly one control period.

        An action that is not finite ends the flight, as a controller's would.

        Raises:
            ParameterError: the action has another shape than `action_space`, or is not of numbers.
            ResetNeeded: there is no episode, or it has ended.
            ClosedEnvironmentError: `close` has been called.
        """
        self._require_open()
        flight = self.started
        if flight.done:
            raise ResetNeeded(f"the episode has ended ({flight.loop.reason or 'the scenario is over'}); call reset()")
        seen = self._seen
        if self._answered and self._answered[0] == flight.k and np.array_equal(self._answered[1], action):
            command = self._answered[2]
        else:
            command = self.actions.command(action, flight.loop.controller.horizon)
        nothing = np.full(len(self.limits), np.inf)
        try:
            sample = flight.loop.step(command)
        except FlightError:
            return self._vector(seen), 0.0, True, False, self._info(nothing, nothing)
        period = one_period(sample, self.scenario.plant.timestep)
        self._truth, self._rotors = period.plant.state[-1], period.plant.speeds[-1]
        try:
            self._seen = flight.loop.observation
        except FlightError:  # lost: no controller would be called any more
            moment = replace(seen.moment, acting=sample.speeds)
            rows = seen.preview
            self._seen = replace(seen, state=self._truth, reference=rows[0], preview=rows[1:], moment=moment)
        terminated = flight.loop.reason is not None or self._seen.moment.phase is Phase.CRASHED
        reward = float(self._reward(self._truth, self._seen.reference, sample.speeds))
        truncated = flight.done and not terminated
        return (
            self._vector(self._seen),
            reward,
            terminated,
            truncated,
            self._info(*_margins(self.limits, period, first=1)),
        )

    def controller_action(self) -> Action:
        """Return the command of the scenario's controller at this time, computed once per period.

        Where that very action is taken next, the controller's command is flown to the bit, with its plan and status:
        such an episode is the flight of `quadsim run`.

        Raises:
            ParameterError: actions are thrust and rates, which a controller does not answer with.
            FlightError: the controller has no answer; a flight of its own would end here.
            ClosedEnvironmentError: `close` has been called.
        """
        self._require_open()
        flight = self.started
        if self._answered is None or self._answered[0] != flight.k:
            seen = self._seen
            self.actions.of(np.zeros(4))  # which those without equivalent speeds refuse
            if isinstance(agent := flight.loop.controller, Agent):
                flight.loop.controller = Assembly(self.scenario).controller()
                flight.loop.controller.reset(agent.speeds)
            command = flight.loop.controller.step(seen.moment, seen.state, seen.preview)
            self.action_for(command)
        assert self._answered is not None
        return self._answered[1]

    def action_for(self, command: Command) -> Action:
        """Return the action equivalent to a command; taken next, it flies that command with its plan and status.

        Raises:
            ParameterError: actions are thrust and rates.
        """
        low, high = self.action_space.low, self.action_space.high
        action = np.clip(self.actions.of(command.speeds), low, high)
        self.fly_instead(action, command)
        return action

    def fly_instead(self, action: Action, command: Command) -> None:
        """Let an action, if it is the next one, fly this command of rotor speeds, with its plan and status."""
        self._answered = (self.started.k, action, command)

    def flight(self) -> Flight:
        """Return the episode so far as an audited flight, which can be saved and plotted."""
        law = self.started.loop.controller
        return replace(self.started.flight(), controller=law.name, solver=law.solver)

    def render(self) -> np.ndarray[Any, np.dtype[np.uint8]] | None:
        """Return the picture (height, width, 3), rendered by a separate process; None without a render mode.

        Raises:
            RenderingUnavailableError: nothing can render here.
            ClosedEnvironmentError: `close` has been called.
        """
        self._require_open()
        if self.render_mode is None:
            return None
        if self._camera is None:
            width, height = self._size
            self._camera = Camera(self.started.actual, self.scenario.obstacles, width=width, height=height)
        return self._camera.picture(self._truth, self._rotors, self._seen.reference, self.started.loop.time)

    def close(self) -> None:
        """Free native memory and the renderer; only `flight` remains."""
        self._closed = True
        if self._flight is not None:
            self._flight.close()
        if self._camera is not None:
            self._camera.close()
            self._camera = None

    def _assembly(self, scenario: Scenario) -> Assembly:
        """Return the parts of an episode, with the bounds of a user's controller where a campaign varies it."""
        assembly = Assembly(scenario)
        return assembly if self._plan is None else assembly.audited()

    def _drawn(self, seed: int | None, options: Mapping[str, Any]) -> Scenario:
        """The scenario of the episode that starts."""
        if self._plan is None:
            if options:
                raise ParameterError("", "options", options, "absent where nothing varies")
            seed = int(self.np_random.integers(2**31)) if seed is None else seed
            return self._base.altered(seed=seed)
        flights = self._plan.spec.flights
        flight = options["flight"] if "flight" in options else int(self.np_random.integers(flights))
        if set(options) - {"flight"} or not (isinstance(flight, int | np.integer) and 0 <= flight < flights):
            raise ParameterError("", "options", options, f"absent, or a flight from 0 to {flights - 1}")
        return self._plan.of(int(flight))

    def _vector(self, seen: Observation) -> Array:
        """Return the observation; beyond its end the reference keeps its last value."""
        rows, acting = seen.preview, seen.moment.acting
        assert acting is not None
        if len(rows) < self._preview:
            last = rows[-1:] if len(rows) else seen.reference[None]
            rows = np.concatenate([rows, np.repeat(last, self._preview - len(rows), axis=0)])
        return self.observations.of(seen.state, rows[: self._preview], acting)

    def _info(self, worst: Array, sampled: Array) -> dict[str, Any]:
        beyond = [
            limit.required and bool(limit.violated(margin) or limit.violated(at_end, sampled=True))
            for limit, margin, at_end in zip(self.limits, worst.tolist(), sampled.tolist(), strict=True)
        ]
        loop, names = self.started.loop, self.constraint_names
        return {
            "margins": dict(zip(names, worst.tolist(), strict=True)),
            "margins_sampled": dict(zip(names, sampled.tolist(), strict=True)),
            "constraint_values": -worst,
            "constraint_violation": int(any(beyond)),
            "cost": float(sum(beyond)),
            "time": loop.time,
            "phase": str(self._seen.moment.phase),
            "reason": loop.reason or "",
        }


class Agent:
    """Placeholder for a controller where actions fly; the scenario's controller is built when first needed."""

    name, solver = "agent", ""

    def __init__(self, horizon: int) -> None:
        self.horizon = horizon

    def reset(self, speeds: Array) -> None:
        """See `quadsim.controller.Controller.reset`."""
        self.speeds = speeds.copy()

    def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
        """Never called: each step has a command."""
        raise NotImplementedError


def _margins(limits: Sequence[Limit], log: FlightLog | PeriodLog, first: int = 0) -> tuple[Array, Array]:
    """(m,) smallest margins of a log, from this row of the plant on, and at its end; inf where there is none."""
    smallest = np.full((2, len(limits)), np.inf)
    for i, limit in enumerate(limits):
        t, values = limit.source.finest(log)
        margins = np.where(limit.holds_at(t), limit.margin(values), np.inf)[first * (limit.source.plant is not None) :]
        if margins.size:
            smallest[:, i] = margins.min(), margins[-1]
    return smallest[0], smallest[1]


def environment_id(name: str) -> str:
    """The id of a scenario of that name.

    Examples:
        >>> import quadsim.gym
        >>> quadsim.gym.environment_id("hummingbird-figure-eight")
        'quadsim/HummingbirdFigureEight-v0'
    """
    words = name.replace("_", "-").replace(".", "-").split("-")
    return f"quadsim/{''.join(word[:1].upper() + word[1:] for word in words)}-v0"


def register_library() -> None:
    """Register the shipped scenarios, without checking them."""
    for name in scenario_names():
        scenario = Scenario.parse(read_scenario(name))
        gymnasium.registry.setdefault(environment_id(name), _specification(scenario, scenario=name))


def _specification(flown_scenario: Scenario, vary: str | Path | None = None, **kwargs: Any) -> EnvSpec:
    """Describe the environment; its time limit is the duration, which a campaign gives to each episode anew."""
    entry_point = f"{__name__}:{QuadrotorEnv.__name__}"
    most = flown_scenario.periods if vary is None else None
    return EnvSpec(environment_id(flown_scenario.name), entry_point, max_episode_steps=most, kwargs=kwargs)


def make_env(scenario: Scenario | str | Path, **options: Any) -> gymnasium.Env[Any, Any]:
    """The environment of any scenario, with the wrappers of `gymnasium.make`: its time limit is the duration.

    With `vary` each episode ends at its own duration; `gymnasium.make` of a registered id keeps the limit of the
    scenario that ships, and takes another as `max_episode_steps`.

    Args:
        scenario: it, or its name or file.
        options: what `QuadrotorEnv` takes: `action`, `observation`, `preview`, `vary`, `reward`, `render_mode`, ...

    Raises:
        InputError: the scenario or an option is not possible.

    Examples:
        >>> import quadsim.gym
        >>> env = quadsim.gym.make_env("hover", action="speeds", observation=("state",))
        >>> observation, info = env.reset(seed=7)
        >>> observation.shape, env.spec.max_episode_steps, info["constraint_violation"]
        ((12,), 200, 0)
        >>> env.close()
    """
    scenario = load_scenario(scenario)
    return gymnasium.make(_specification(scenario, options.get("vary"), scenario=scenario), **options)


def make_vec(scenario: Scenario | str | Path, num_envs: int, **options: Any) -> VectorEnv:
    """The same several times over, each in a process of its own; an episode's end is reset in the next step.

    Args:
        scenario: it, or its name or file.
        num_envs: how many.
        options: as of `make_env`.

    Raises:
        InputError: as of `make_env`.

    Examples:
        >>> import quadsim.gym
        >>> envs = quadsim.gym.make_vec("hover", 2)
        >>> envs.reset(seed=7)[0].shape, str(envs.metadata["autoreset_mode"])
        ((2, 216), 'AutoresetMode.NEXT_STEP')
        >>> envs.close()
    """
    if num_envs < 1:
        raise ParameterError("", "num_envs", num_envs, "at least 1")
    scenario = load_scenario(scenario)
    specification = _specification(scenario, options.get("vary"), scenario=scenario)
    return gymnasium.make_vec(specification, num_envs, "async", **options)
