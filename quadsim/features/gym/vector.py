"""Many environments of a scenario in one process: the core flies them together.

A step checks the actions, lets a fleet fly them (`fleet.py`), resets the episodes that ended, and records the actions,
so that `flight` can fly any recent episode again, to the bit, as an audited flight.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from quadsim.errors import ParameterError
from quadsim.features.gym.environment import QuadrotorEnv
from quadsim.features.gym.episodes import Episode, Variation
from quadsim.features.gym.fleet import Apart, Flags, Fleet, StepResults, Together, obstacle_to_batch
from quadsim.features.gym.rewards import Reward, RewardHook, nearness
from quadsim.features.gym.spaces import USUAL, Action, check_action
from quadsim.rollout.flown import Flight
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.sim.margins import Margins
from quadsim.state import Array


class QuadrotorVectorEnv(VectorEnv):  # type: ignore[misc]
    """N environments of a scenario, one step per control period, in this process.

    Observations, actions, rewards, ends and `info` are those of `QuadrotorEnv`, each with an axis of N before, as
    Gymnasium has it: environment i of `reset(seed=s)` is a `QuadrotorEnv` of `reset(seed=s + i)`, bit for bit, whatever
    N and the number of threads.  The core flies them together; where it cannot (`obstacle`), they are flown one by one.

    `info` has arrays (N,) of what that of an environment has, with masks such as `_time`; `margins["roll"]` is (N,),
    `constraint_values` (N, m).

    Attributes:
        scenario: the scenario that episodes vary.
        constraint_names: the names of the limits, in the order of `constraint_values`.
        obstacle: why they are flown one by one; None: they are not.
        observations: what an observation has, with the unit of each entry.

    Examples:
        >>> import numpy as np
        >>> import quadsim.gym
        >>> envs = quadsim.gym.make_vec("hummingbird-figure-eight", 8, action="rates", observation=("ahead", "state"))
        >>> observations, infos = envs.reset(seed=0)
        >>> observations, rewards, terminated, truncated, infos = envs.step(np.zeros((8, 4), np.float32))
        >>> observations.shape, infos["margins"]["roll"].shape, bool(terminated.any())
        ((8, 172), (8,), False)
        >>> envs.close()
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012  as Gymnasium has it

    def __init__(
        self,
        scenario: Scenario | str | Path,
        num_envs: int,
        *,
        action: str = "deviations",
        observation: Sequence[str] = USUAL,
        preview: int | None = None,
        vary: Variation | None = None,
        reward: Reward = nearness,
        margins: bool = True,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        threads: int = 1,
        render_mode: str | None = None,
    ) -> None:
        """Set up; nothing is flown before `reset`.

        Args:
            scenario: as of `QuadrotorEnv`, as the next four.
            num_envs: N.
            action: what an action means; see `quadsim.features.gym.spaces.Actions`.
            observation: parts of the observation.
            preview: observed periods of the reference.
            vary: what each environment draws anew at each reset.
            reward: of arrays: states (N, 12), references (N, 4), speeds (N, 4) and, if it takes them, `margins`, (N,)
                each by name; returns (N,).
            margins: whether `info` has margins, violations and cost, which take time.
            autoreset_mode: when an ended episode is reset: `NextStep`, `SameStep` or `Disabled`.
            max_episode_steps: truncates episodes before the scenario's duration.
            threads: how many of them fly the vehicles.
            render_mode: None; `flight` has episodes that can be filmed.

        Raises:
            InputError: an argument is not allowed.
        """
        options: dict[str, Any] = {"action": action, "observation": observation, "preview": preview}
        self._single = QuadrotorEnv(scenario, vary=vary, **options)
        _require_whole("num_envs", num_envs)
        _require_whole("threads", threads)
        if max_episode_steps is not None:
            _require_whole("max_episode_steps", max_episode_steps)
        rewards = RewardHook(reward)
        if rewards.takes_margins and not margins:
            raise ParameterError("", "margins", margins, "True for a reward with a parameter margins")
        if render_mode is not None:
            rule = "None: envs.flight(i).save(directory) films an episode of environment i"
            raise ParameterError("", "render_mode", render_mode, rule)
        self._autoreset = _autoreset_mode(autoreset_mode)
        self.num_envs = int(num_envs)
        self.metadata = {**self.metadata, "autoreset_mode": self._autoreset}
        self._episodes = self._single.episodes
        self.scenario = self._episodes.base
        self.observations = self._single.observations
        self.constraint_names: tuple[str, ...] = ()
        if margins:
            self.constraint_names = self._single.constraint_names
        self.single_action_space = self._single.action_space
        self.single_observation_space = self.observations.space
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.render_mode = None
        self._generators: list[np.random.Generator | None] = [None] * self.num_envs
        self.obstacle = self._obstacle_to_batch(margins=margins)
        entries = len(self.observations.layout)
        self._frame = StepResults.empty(self.num_envs, entries, len(self.constraint_names))
        shared: dict[str, Any] = {"rewards": rewards, "most": max_episode_steps}
        self._fleet: Fleet
        if self.obstacle is None:
            self._fleet = Together(self._single, self.num_envs, margins=margins, threads=threads, **shared)
        else:
            self._fleet = Apart(self._single, self.num_envs, options, **shared)
        self._started = np.zeros(self.num_envs, bool)
        self._ended = np.zeros(self.num_envs, bool)
        self._of_episodes: dict[str, Any] = {}  # in `info`, until the next reset
        self._log = _ActionLog(self.num_envs)

    def _obstacle_to_batch(self, *, margins: bool) -> str | None:
        """Return what keeps the core from flying the environments at once, or None."""
        obstacle = obstacle_to_batch(self.scenario)
        if obstacle is None and margins:
            compiled = Margins(self._single.limits, self.scenario.plant.timestep).compiled
            if not compiled:
                return "a constraint whose margins Python computes"
        return obstacle

    @property
    def np_random(self) -> tuple[np.random.Generator | None, ...]:
        """The environments' generators; None before the first reset."""
        return tuple(self._generators)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start an episode in each environment.

        Args:
            seed: environment i has seed + i, or its own of N; see `QuadrotorEnv.reset`. Without any, the first episodes
                have the scenario's, and further ones draw from the last that was given.
            options: `flight`, as of `QuadrotorEnv.reset`, for all of them; `reset_mask`, (N,) flags: those alone that
                are reset.

        Raises:
            InputError: a seed or an option is not allowed.
            ClosedEnvironmentError: `close` has been called.
        """
        self._require_open()
        seeds = self._seeds(seed)
        options = dict(options or {})
        mask = self._mask(options.pop("reset_mask", None))
        episodes: dict[int, Episode] = {}
        for place in np.flatnonzero(mask).tolist():
            episodes[place] = self._draw(place, seeds[place], options)
        frame = self._next_frame()
        self._start(episodes, frame)
        self._frame = frame
        return frame.observations.copy(), self._info(mask)

    def step(self, actions: Action) -> tuple[Array, Array, Flags, Flags, dict[str, Any]]:
        """Fly one control period in each environment.

        With `NextStep`, the step after an episode's end resets that environment, whatever its action.  With `SameStep`,
        `info` has `final_obs` and `final_info` of episodes that ended.

        An action that is NaN ends its environment's episode, as a diverged vehicle does, and no other's.

        Raises:
            ParameterError: the actions have another shape than `action_space`, are not of numbers, or are outside.
            ResetNeeded: `reset` has not been called, or, with `Disabled`, an episode has ended.
            ClosedEnvironmentError: `close` has been called.
        """
        self._require_open()
        if not self._started.all():
            raise ResetNeeded("call envs.reset() first")
        if self._autoreset is AutoresetMode.DISABLED and self._ended.any():
            over = np.flatnonzero(self._ended).tolist()
            raise ResetNeeded(f"the episodes of {over} have ended: reset them with options={{'reset_mask': ...}}")
        numbers = check_action(actions, self.action_space)
        to_reset = self._ended.copy()  # none, unless the mode is NEXT_STEP
        frame = self._next_frame()
        self._log.append(numbers)
        self._fleet.step(numbers, ~to_reset, frame)
        if to_reset.any():
            self._start(self._next_episodes(to_reset), frame)
        self._frame = frame
        ended = frame.terminated | frame.truncated
        self._log.end(ended)
        if self._autoreset is not AutoresetMode.SAME_STEP or not ended.any():
            self._ended = ended
            info = self._info(self._started.copy())
            return frame.observations.copy(), frame.rewards, frame.terminated, frame.truncated, info
        return self._reset_at_once(ended)

    def flight(self, place: int, *, ended: bool = False) -> Flight:
        """Return an environment's episode as an audited flight, which can be saved, plotted and filmed.

        It is flown again by the recorded actions: the same bits.  Its `save` also films it, which may take minutes;
        `save(directory, video=False)` does without the film.

        Args:
            place: the environment, from 0 to N - 1.
            ended: the last episode that ended; absent: the one under way, or that has ended and is not yet reset.

        Raises:
            ParameterError: there is no such environment.
            ResetNeeded: there is no such episode.
            ClosedEnvironmentError: `close` has been called.
        """
        self._require_open()
        if not (isinstance(place, int | np.integer) and 0 <= place < self.num_envs):
            raise ParameterError("", "place", place, f"from 0 to {self.num_envs - 1}")
        recorded = self._log.recorded(int(place), ended=ended)
        if recorded is None:
            missing = "yet: call reset()"
            if ended:
                missing = "that ended"
            raise ResetNeeded(f"environment {place} has no episode {missing}")
        episode, actions = recorded
        return self._single.replay(episode, actions)

    def close_extras(self, **_: Any) -> None:
        """Free native memory."""
        self._fleet.close()
        self._single.close()

    def _require_open(self) -> None:
        if self.closed:
            raise ClosedEnvironmentError("the environments are closed; make new ones")

    def _next_frame(self) -> StepResults:
        """Return new arrays for the results of a step, as users keep the last ones; observations start as they were."""
        last = self._frame
        frame = StepResults.empty(self.num_envs, last.observations.shape[1], last.smallest.shape[1])
        frame.observations[:] = last.observations
        return frame

    def _seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        """Return the seed of each environment, from one number, N of them, or none."""
        if seed is None:
            return [None] * self.num_envs
        if isinstance(seed, int | np.integer):
            self._episodes.check_seed(seed)
            self._episodes.check_seed(int(seed) + self.num_envs - 1)
            return [int(seed) + place for place in range(self.num_envs)]
        seeds = list(seed)
        if len(seeds) != self.num_envs:
            raise ParameterError("", "seed", seed, f"one number, or {self.num_envs}")
        for stated in seeds:
            if stated is not None:
                self._episodes.check_seed(stated)
        return seeds

    def _mask(self, mask: Any) -> Flags:
        """Return which environments are reset: all, or those of a mask (N,)."""
        if mask is None:
            return np.ones(self.num_envs, bool)
        flags = np.array(mask)
        if flags.shape != (self.num_envs,) or flags.dtype != np.bool_ or not flags.any():
            raise ParameterError("options", "reset_mask", mask, f"{self.num_envs} flags, one of them true at least")
        return flags

    def _next_episodes(self, ended: Flags) -> dict[int, Episode]:
        """Draw the next episodes of the environments whose last has ended."""
        episodes = {}
        for place in np.flatnonzero(ended).tolist():
            episodes[place] = self._draw(place, None, {})
        return episodes

    def _draw(self, place: int, seed: int | None, options: Mapping[str, Any]) -> Episode:
        """Draw an environment's next episode."""
        generator = self._generators[place]
        if seed is None and generator is None:
            seed = self.scenario.seed + place
        if seed is not None:
            generator, _ = np_random(seed)
            self._generators[place] = generator
        assert generator is not None
        return self._episodes.draw(seed, options, generator)

    def _start(self, episodes: Mapping[int, Episode], frame: StepResults) -> None:
        """Start episodes; fill in their rows."""
        self._of_episodes = deepcopy(self._of_episodes)  # users keep the last one's arrays
        self._fleet.reset(episodes, frame)
        for place, episode in episodes.items():
            self._log.start(place, episode)
            self._started[place] = True
            self._ended[place] = False
            self._note(place, episode)
        self._log.trim()

    def _note(self, place: int, episode: Episode) -> None:
        """Note what `info` has of an episode."""
        numbers = {"seed": episode.scenario.seed}
        if episode.flight is not None:
            numbers["flight"] = episode.flight
        for name, number in numbers.items():
            self._of_episodes.setdefault(name, np.zeros(self.num_envs, np.int64))[place] = number
        if episode.flight is not None:
            draws = self._of_episodes.setdefault("draw", {})
        else:
            draws = {}
        for name, value in episode.draw.items():
            kind: type = object
            if isinstance(value, int | float) and not isinstance(value, bool):
                kind = float
            draws.setdefault(name, np.zeros(self.num_envs, kind))[place] = value

    def _info(self, mask: Flags) -> dict[str, Any]:
        """Return `info` of the last frame, where a mask holds."""
        frame = self._frame
        names = self.constraint_names
        info: dict[str, Any] = {}
        if names:
            info["margins"] = _masked(dict(zip(names, frame.smallest.T.copy(), strict=True)), mask)
            info["margins_sampled"] = _masked(dict(zip(names, frame.at_end.T.copy(), strict=True)), mask)
            info["constraint_values"] = -frame.smallest
            info["constraint_violation"] = frame.violated.any(axis=1).astype(np.int64)
            info["cost"] = frame.violated.sum(axis=1, dtype=np.float64)
        info["time"] = frame.time.copy()
        info["phase"] = frame.phases.copy()
        info["reason"] = frame.reasons.copy()
        for name, values in self._of_episodes.items():
            if isinstance(values, dict):
                info[name] = _masked(values, mask)
            else:
                info[name] = values
        return _masked(info, mask)

    def _reset_at_once(self, ended: Flags) -> tuple[Array, Array, Flags, Flags, dict[str, Any]]:
        """Reset the episodes that have ended in this step."""
        frame = self._frame
        rewards = frame.rewards.copy()
        terminated = frame.terminated.copy()
        truncated = frame.truncated.copy()
        final_info = self._info(ended)
        final_observations = np.full(self.num_envs, None, object)
        for place in np.flatnonzero(ended).tolist():
            final_observations[place] = frame.observations[place].copy()
        self._start(self._next_episodes(ended), frame)
        self._ended = np.zeros(self.num_envs, bool)
        info = self._info(self._started.copy())
        info["final_info"] = final_info
        info["_final_info"] = ended
        info["final_obs"] = final_observations
        info["_final_obs"] = ended
        return frame.observations.copy(), rewards, terminated, truncated, info


class _ActionLog:
    """The actions of each environment's present episode and of the one before."""

    def __init__(self, count: int) -> None:
        self._steps: deque[Array] = deque()
        self._dropped = 0  # steps before those that are kept
        self._present: list[tuple[Episode, int] | None] = [None] * count  # and the number of its first step
        self._ended: list[tuple[Episode, int, int] | None] = [None] * count  # and that of the first after it

    @property
    def _next(self) -> int:
        return self._dropped + len(self._steps)

    def append(self, actions: Array) -> None:
        """Record a step's actions (N, 4)."""
        self._steps.append(actions)

    def start(self, place: int, episode: Episode) -> None:
        """Start an episode with the next step."""
        self._present[place] = episode, self._next

    def trim(self) -> None:
        """Drop the steps of episodes that are no longer kept."""
        kept = [present[1] for present in self._present if present is not None]
        kept += [ended[1] for ended in self._ended if ended is not None]
        while self._dropped < min(kept):
            self._steps.popleft()
            self._dropped += 1

    def end(self, ended: Flags) -> None:
        """End the episodes of some places with the last step."""
        for place in np.flatnonzero(ended).tolist():
            present = self._present[place]
            assert present is not None
            self._ended[place] = *present, self._next

    def recorded(self, place: int, *, ended: bool) -> tuple[Episode, list[Array]] | None:
        """Return an episode and its actions (4,): the last that ended, or the present one."""
        last = self._ended[place]
        present = self._present[place]
        if ended or (last is not None and present is not None and last[1] == present[1]):
            if last is None:
                return None
            episode, first, end = last
        elif present is not None:
            episode, first = present
            end = self._next
        else:
            return None
        actions = []
        for number in range(first, end):
            actions.append(self._steps[number - self._dropped][place])
        return episode, actions


def _require_whole(name: str, number: object) -> None:
    """Refuse an argument that is not a whole number of at least 1."""
    if not (isinstance(number, int | np.integer) and number >= 1):
        raise ParameterError("", name, number, "a whole number of at least 1")


def _autoreset_mode(mode: AutoresetMode | str) -> AutoresetMode:
    """Return a mode of Gymnasium by its name."""
    try:
        return AutoresetMode(mode)
    except ValueError:
        modes = ", ".join(known.value for known in AutoresetMode)
        raise ParameterError("", "autoreset_mode", mode, f"one of {modes}") from None


def _masked(values: dict[str, Any], mask: Flags) -> dict[str, Any]:
    """Return values with the mask of the environments that have them, as Gymnasium does."""
    masks = {f"_{name}": mask for name in values}
    return {**values, **masks}
