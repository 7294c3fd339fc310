"""One scenario as a Gymnasium environment: the plant, sensors, air and audit of `quadsim run`, an agent in the loop."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded

from quadsim.controller import Command, Controller, Moment, Phase
from quadsim.errors import FlightError, InputError, ParameterError
from quadsim.flight.audit import Limit
from quadsim.flight.log import FlightLog, PlantLog
from quadsim.sim.loop import Observation, one_period
from quadsim.state import REFERENCE_STATES, Array
from scenarios.api import as_scenario
from scenarios.build import build_controller
from scenarios.flight import Flight
from scenarios.gym.actions import Action, make_actions
from scenarios.gym.observations import USUAL, Observations
from scenarios.gym.randomisation import make_plan
from scenarios.gym.rendering import Screen, has_display, make_screen
from scenarios.limits import build_limits
from scenarios.parts.vehicle import build_vehicle
from scenarios.run import StartedFlight, start
from scenarios.schema.base import LARGEST_SEED
from scenarios.schema.scenario import Scenario

Reward = Callable[[Array, Array, Array], float]
"""From the true state (12,) after a step, the reference (4,) there, and the rotor speeds commanded (4,) [rad/s]."""
RENDER_MODES: Final = ("rgb_array", "human") if has_display() else ("rgb_array",)  # `human` where there is a display


def nearness(state: Array, reference: Array, speeds: Array) -> float:
    """The usual reward, exp(-d) in (0, 1], d the distance from the reference [m] and the error of yaw [rad] added up.

    It is never negative, so that no episode is better for ending early.
    """
    error = state[list(REFERENCE_STATES)] - reference
    return math.exp(-math.hypot(*error[:3].tolist()) - abs(math.remainder(float(error[3]), math.tau)))


class QuadrotorEnv(gymnasium.Env):  # type: ignore[misc]
    """A scenario, one step per control period.

    Observations and actions are as chosen; see `scenarios.gym.observations` and `scenarios.gym.actions`.  An episode
    is terminated when the vehicle is lost by a criterion of `[lost]`, has crashed, or has diverged, and truncated at
    the scenario's duration, which a campaign's `[set]` may change.

    `info` at each step, and at the start:

    - `margins`: signed margin of each constraint at its worst within the step, at the physics rate, in the constraint's
      unit; negative = violated, inf outside its time window.
    - `margins_sampled`: the same at the end of the step alone, all that a check at the control rate sees.
    - `constraint_values`: (m,) g = -margin in the order of `constraint_names`, so that g <= 0 holds; -inf outside.
    - `constraint_violation`: 1 where a required constraint was violated beyond its tolerances, else 0.
    - `cost`: how many were.
    - `time` [s], `phase` (`flying`, `landed`, ...), `reason` (why the flight ended; empty while it has not).

    Attributes:
        scenario: what is flown in this episode.
        limits: its constraints, as the audit has them.
        actions: what actions are.
        observations: what is observed, with the unit of each entry.

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

    metadata: dict[str, Any] = {"render_modes": [*RENDER_MODES], "render_fps": 20}  # noqa: RUF012  as Gymnasium has it

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
            scenario: what is flown, or its name or file.
            action: `deviations` from hover, rotor `speeds` [rad/s], or collective thrust and body `rates`.
            observation: parts, of `state`, `preview`, `ahead` and `command`.
            preview: periods of reference that are observed; the controller's horizon where absent, and at most.
            vary: a campaign, its name or file, whose `[set]` changes the scenario and whose `[[vary]]` is drawn anew
                at each reset.
            reward: of a step; see `Reward`.
            render_mode: `rgb_array`, `human`, or None.
            width: of pictures [pixels].
            height: likewise.

        Raises:
            InputError: one of these is not possible.
        """
        scenario = as_scenario(scenario)
        self._plan = None if vary is None else make_plan(scenario, str(vary))
        self._base = scenario if self._plan is None else self._plan.scenario
        if render_mode not in (None, *RENDER_MODES):
            rule = f"{' or '.join(RENDER_MODES)}, or None" + ("" if has_display() else "; human needs a display")
            raise ParameterError("", "render_mode", render_mode, rule)
        horizon = self._base.controller.horizon
        preview = horizon if preview is None else preview
        if not 1 <= preview <= horizon:
            raise ParameterError("", "preview", preview, f"from 1 to controller.horizon = {horizon} periods")
        self.metadata = {**self.metadata, "render_fps": max(1, round(1.0 / self._base.control_period))}
        self.observations = Observations(observation, preview)
        self.actions = make_actions(action, self._base, build_vehicle(self._base))
        self.action_space, self.observation_space = self.actions.space, self.observations.space
        self.render_mode, self._size = render_mode, (width, height)
        self._preview, self._reward, self._action = preview, reward, action
        self._flight: StartedFlight | None = None
        self._screen: Screen | None = None
        self._started = False
        self.scenario, self.limits = self._base, build_limits(self._base)

    @property
    def constraint_names(self) -> tuple[str, ...]:
        """The names of `limits`, in the order of `constraint_values`."""
        return tuple(limit.name for limit in self.limits)

    @property
    def started(self) -> StartedFlight:
        """The flight of this episode.

        Raises:
            ResetNeeded: there is none yet.
        """
        if self._flight is None:
            raise ResetNeeded("call env.reset() first")
        return self._flight

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: the scenario's, as of `quadsim run --seed`.  Without one the first episode has the scenario's own, and
                each further one a seed drawn from the last that was given.  Where something varies, it is what the
                campaign's flight is drawn from.
            options: `flight`, the number of a flight of the campaign that varies something.

        Raises:
            InputError: the seed or an option is not possible.
        """
        if seed is not None and not (isinstance(seed, int | np.integer) and 0 <= seed <= LARGEST_SEED):
            raise ParameterError("", "seed", seed, f"from 0 to {LARGEST_SEED}")
        first = not self._started
        super().reset(seed=self._base.seed if first and seed is None else seed)
        self._started = True
        scenario = self._drawn(seed, first, dict(options or {}))
        if self._flight is not None:
            self._flight.close()
        self.scenario = scenario
        vehicle = build_vehicle(scenario)
        if self._plan is not None:
            self.actions = make_actions(self._action, scenario, vehicle)
        law = OnDemand(lambda: build_controller(scenario, vehicle), scenario.controller.horizon)
        self._law = None if scenario.controller_changes else law  # events that change it need the controller itself
        self._flight = start(scenario, self._law)
        self.limits = self._flight.limits
        self._queried: _Queried | None = None
        self._seen, plant = self._flight.observation, self._flight.loop.log().plant
        self._truth, self._rotors = plant.state[-1], plant.speeds[-1]
        if self.render_mode == "human":
            self._draw()
        return self._vector(self._seen), self._info(*_start_margins(self.limits, plant))

    def step(self, action: Action) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Fly one control period.

        An action that is not finite ends the flight, as a controller's would.

        Raises:
            ParameterError: the action has another shape than `action_space`.
            ResetNeeded: there is no episode, or it has ended.
        """
        flight = self.started
        if flight.done:
            raise ResetNeeded(f"the episode has ended ({flight.loop.reason or 'the scenario is over'}); call reset()")
        if np.shape(action) != self.action_space.shape:
            raise ParameterError("", "action", np.shape(action), f"of shape {self.action_space.shape}")
        queried, seen = self._queried, self._seen
        command = (
            queried.command
            if queried is not None and queried.k == flight.k and np.array_equal(queried.action, action)
            else self.actions.command(action, seen.moment.body_rates, flight.loop.controller.horizon)
        )
        nothing = np.full(len(self.limits), np.inf)
        try:
            sample = flight.loop.step(command)
        except FlightError:
            return self._vector(seen), 0.0, True, False, self._info(nothing, nothing)
        period = one_period(sample, self.scenario.plant.timestep)
        self._truth, self._rotors = state, _ = period.plant.state[-1], period.plant.speeds[-1]
        try:
            self._seen = flight.loop.observation
        except FlightError:  # lost: no controller would be called any more
            moment = replace(seen.moment, acting=sample.speeds)
            rows = seen.preview
            self._seen = replace(seen, state=state, reference=rows[0], preview=rows[1:], moment=moment)
        terminated = flight.loop.reason is not None or self._seen.moment.phase is Phase.CRASHED
        if self.render_mode == "human":
            self._draw()
        reward = float(self._reward(state, self._seen.reference, sample.speeds))
        truncated = flight.done and not terminated
        return self._vector(self._seen), reward, terminated, truncated, self._info(*_margins(self.limits, period))

    def controller_action(self) -> Action:
        """What the scenario's own controller would do now, computed once per period.

        Where that very action is taken next, the controller's command is flown to the bit, with its plan and status:
        such an episode is the flight of `quadsim run`.

        Raises:
            ParameterError: actions are thrust and rates, which a controller does not answer with.
            FlightError: the controller has no answer; a flight of its own would end here.
        """
        flight = self.started
        if self._queried is None or self._queried.k != flight.k:
            seen = self._seen
            self.actions.of(np.zeros(4))  # which those without equivalent speeds refuse
            command = flight.loop.controller.step(seen.moment, seen.state, seen.preview)
            self.action_for(command)
        assert self._queried is not None
        return self._queried.action

    @property
    def controller_status(self) -> str:
        """The status of the last query; see `quadsim.controller.Command`."""
        return "" if self._queried is None else self._queried.command.status

    def action_for(self, command: Command) -> Action:
        """The action equivalent to a command: taken next, that very command is flown, with its plan and status.

        Raises:
            ParameterError: actions are thrust and rates.
        """
        low, high = self.action_space.low, self.action_space.high
        self._queried = _Queried(self.started.k, np.clip(self.actions.of(command.speeds), low, high), command)
        return self._queried.action

    def flight(self) -> Flight:
        """This episode so far as a flight: audited, to be saved and drawn like any other."""
        flight = self.started.flight()
        return flight if self._law is None else replace(flight, controller=self._law.name, solver=self._law.solver)

    def render(self) -> np.ndarray[Any, np.dtype[np.uint8]] | None:
        """The picture (height, width, 3) in the mode `rgb_array`; the window of `human` is drawn by each step.

        Raises:
            RenderingUnavailableError: nothing can render here.
        """
        return self._draw() if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Give native memory, the renderer and the window back."""
        if self._flight is not None:
            self._flight.close()
        if self._screen is not None:
            self._screen.close()
            self._screen = None

    def _drawn(self, seed: int | None, first: bool, options: dict[str, Any]) -> Scenario:
        """The scenario of the episode that starts."""
        if unknown := set(options) - {"flight"}:
            raise InputError(f"options must not have {', '.join(sorted(unknown))}; they may have flight")
        if self._plan is not None:
            count = self._plan.spec.flights
            flight = options["flight"] if "flight" in options else int(self.np_random.integers(count))
            if not (isinstance(flight, int | np.integer) and 0 <= flight < count):
                raise ParameterError("options", "flight", flight, f"from 0 to {count - 1}")
            return self._plan.of(int(flight))
        if "flight" in options:
            raise ParameterError("options", "flight", options["flight"], "absent where no campaign varies anything")
        if seed is None:
            seed = self._base.seed if first else int(self.np_random.integers(2**31))
        return self._base.model_copy(update={"seed": seed})

    def _vector(self, seen: Observation) -> Array:
        """What is observed; beyond its end the reference stays where it is."""
        rows, acting = seen.preview, seen.moment.acting
        assert acting is not None
        if len(rows) < self._preview:
            last = rows[-1:] if len(rows) else seen.reference[None]
            rows = np.concatenate([rows, np.repeat(last, self._preview - len(rows), axis=0)])
        return self.observations.of(seen.state, rows[: self._preview], acting)

    def _info(self, worst: Array, sampled: Array) -> dict[str, Any]:
        beyond = [
            limit.required and (margin < -limit.tolerance or at_end < -limit.tolerance_sampled)
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

    def _draw(self) -> np.ndarray[Any, np.dtype[np.uint8]] | None:
        if self._screen is None:
            self._screen = make_screen(self.render_mode, self.scenario, self.started.actual, *self._size)
        return self._screen.show(self._truth, self._rotors, self._seen.reference, self.started.loop.time)


@dataclass(frozen=True)
class _Queried:
    """What the controller answered in a period."""

    k: int
    action: Action
    command: Command


class OnDemand:
    """A scenario's controller that is made at its first call: agents fly without it."""

    def __init__(self, build: Callable[[], Controller], horizon: int) -> None:
        self._build, self.horizon = build, horizon
        self._inner: Controller | None = None

    @property
    def name(self) -> str:
        """That of the controller; `agent` where it was never called."""
        return "agent" if self._inner is None else self._inner.name

    @property
    def solver(self) -> str:
        """Likewise; empty."""
        return "" if self._inner is None else self._inner.solver

    def reset(self, speeds: Array) -> None:
        """See `quadsim.controller.Controller.reset`."""
        self._speeds = speeds.copy()
        if self._inner is not None:
            self._inner.reset(speeds)

    def step(self, now: Moment, state: Array, reference: Array) -> Command:
        """See `quadsim.controller.Controller.step`."""
        if self._inner is None:
            self._inner = self._build()
            self._inner.reset(self._speeds)
        return self._inner.step(now, state, reference)

    def __getattr__(self, name: str) -> Any:
        """What else the controller has, once it is there: `predict`, `unanswered`."""
        inner = self.__dict__.get("_inner")
        if inner is None:
            raise AttributeError(name)
        return getattr(inner, name)


def _margins(limits: Sequence[Limit], period: FlightLog) -> tuple[Array, Array]:
    """(m,) smallest margins within a period, its begin left out, which is the end of the one before, and at its end."""
    worst, sampled = np.empty(len(limits)), np.empty(len(limits))
    for i, limit in enumerate(limits):
        t, values = limit.source.finest(period)
        if limit.source.plant is not None:
            t, values = t[1:], values[1:]
        margins = np.where(limit.holds_at(t), limit.margin(values), np.inf)
        worst[i], sampled[i] = margins.min(), margins[-1]
    return worst, sampled


def _start_margins(limits: Sequence[Limit], plant: PlantLog) -> tuple[Array, Array]:
    """(m,), twice, of the state at the start; inf of what exists at control samples alone."""
    found = [
        np.inf if limit.source.plant is None or not limit.holds_at(plant.t)[0]
        else float(limit.margin(limit.source.plant(plant))[0])
        for limit in limits
    ]  # fmt: skip
    return np.array(found, float), np.array(found, float)
