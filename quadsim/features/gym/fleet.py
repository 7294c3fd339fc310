"""Fleets fly many environments: `Together` by the core, all at once; `Apart` one after another, where it cannot.

Each step, `Together` turns actions into commands, lets the core fly a control period, and computes observations,
margins, rewards and ends for all N at once, with the bits of single environments.  `vector.py` draws and resets.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from quadsim.controller import Phase
from quadsim.errors import FlightError, InputError
from quadsim.features.gym.environment import QuadrotorEnv
from quadsim.features.gym.episodes import Episode
from quadsim.features.gym.rewards import RewardHook
from quadsim.features.gym.spaces import Actions, action_commands
from quadsim.flight.phase import CRITERIA, check_loss
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.schema.events import ControllerEvent, SetpointEvent
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.sim.autopilot import Autopilot
from quadsim.sim.batch import PlantBatch
from quadsim.sim.computation import Stall
from quadsim.sim.margins import Margins, violated
from quadsim.sim.navigation import Navigation
from quadsim.sim.plant import Plant
from quadsim.state import INDEX, VELOCITIES, Array, follow_turns, tilt

Flags = NDArray[np.bool_]

_YAW: Final = INDEX["yaw"]
_HEIGHT: Final = INDEX["z"]
_NEAR_LOSS: Final = 1.0 - 1e-6  # share of a limit of [lost] beyond which a vehicle is checked by itself
MOST_SETUPS: Final = 1024  # drawn flights whose parts are kept


def obstacle_to_batch(scenario: Scenario) -> str | None:
    """Return the first thing in a scenario that the core cannot fly by itself between two actions; None without."""
    ground = scenario.effects.ground
    reasons = {
        "an estimator": scenario.estimator is not None,
        "computation time": scenario.computation is not None,
        "contact with the ground": ground is not None and ground.contact,
        "obstacles": bool(scenario.obstacles),
        "regions": bool(scenario.regions),
    }
    for event in scenario.events:
        if isinstance(event, Stall | SetpointEvent | ControllerEvent):
            reasons[f"the event {event.type!r}"] = True
    for reason, present in reasons.items():
        if present:
            return reason
    return None


@dataclass
class StepResults:
    """The results of a step or a reset, an entry or a row for each of N environments."""

    observations: Array  # (N, n_o)
    rewards: Array  # (N,)
    terminated: Flags  # (N,)
    truncated: Flags  # (N,)
    smallest: Array  # (N, m) margins within the step
    at_end: Array  # (N, m) and at its end
    violated: Flags  # (N, m) required limits
    time: Array  # (N,) [s]
    phases: NDArray[np.object_]  # (N,) texts
    reasons: NDArray[np.object_]  # (N,) texts

    @classmethod
    def empty(cls, count: int, entries: int, limits: int) -> StepResults:
        """Return results to fill in: of N environments, of observations with so many entries, and of m limits."""
        return cls(
            observations=np.zeros((count, entries)),
            rewards=np.zeros(count),
            terminated=np.zeros(count, bool),
            truncated=np.zeros(count, bool),
            smallest=np.full((count, limits), np.inf),
            at_end=np.full((count, limits), np.inf),
            violated=np.zeros((count, limits), bool),
            time=np.zeros(count),
            phases=np.full(count, str(Phase.FLYING), object),
            reasons=np.full(count, "", object),
        )


class Fleet(Protocol):
    """N environments, each somewhere in its episode."""

    def reset(self, episodes: Mapping[int, Episode], frame: StepResults) -> None:
        """Start episodes at their places; fill in these rows.

        Raises:
            QuadsimError: one cannot be flown.
        """
        ...

    def step(self, actions: Array, flying: Flags, frame: StepResults) -> None:
        """Fly a control period by actions (N, 4) wherever it flies (N,); fill in these rows."""
        ...

    def close(self) -> None:
        """Free native memory."""
        ...


class Apart:
    """Single environments, one after another."""

    def __init__(
        self, single: QuadrotorEnv, count: int, options: dict[str, Any], *, rewards: RewardHook, most: int | None
    ) -> None:
        """Set up as `single` is, by its options; `most` steps end an episode."""
        self._environments = [QuadrotorEnv(single.episodes, **options) for _ in range(count)]
        self._rewards = rewards
        self._most = most
        self._names = single.constraint_names
        self._state = np.zeros((count, 12))
        self._reference = np.zeros((count, 4))
        self._speeds = np.zeros((count, 4))

    def reset(self, episodes: Mapping[int, Episode], frame: StepResults) -> None:
        """See `Fleet`."""
        for place, episode in episodes.items():
            observed, info = self._environments[place].start(episode)
            frame.observations[place] = observed
            frame.rewards[place] = 0.0
            frame.terminated[place] = False
            frame.truncated[place] = False
            self._fill(place, info, frame)

    def step(self, actions: Array, flying: Flags, frame: StepResults) -> None:
        """See `Fleet`."""
        diverged = np.zeros(len(flying), bool)
        for place in np.flatnonzero(flying).tolist():
            environment = self._environments[place]
            before = environment.started.k
            observed, _, terminated, truncated, info = environment.step(actions[place])
            diverged[place] = environment.started.k == before
            at_limit = self._most is not None and before + 1 >= self._most
            frame.observations[place] = observed
            frame.terminated[place] = terminated
            frame.truncated[place] = truncated or (at_limit and not terminated)
            self._fill(place, info, frame)
        margins = dict(zip(self._names, frame.smallest.T, strict=False))
        rewards = self._rewards.of_many(self._state.copy(), self._reference.copy(), self._speeds.copy(), margins)
        frame.rewards[:] = np.where(flying & ~diverged, rewards, 0.0)

    def close(self) -> None:
        """See `Fleet`."""
        for environment in self._environments:
            environment.close()

    def _fill(self, place: int, info: dict[str, Any], frame: StepResults) -> None:
        """Fill in the row of an environment, but for observation, reward and end, which its step returned."""
        frame.time[place] = info["time"]
        frame.phases[place] = info["phase"]
        frame.reasons[place] = info["reason"]
        state, reference, speeds = self._environments[place].outcome
        self._state[place] = state
        self._reference[place] = reference
        self._speeds[place] = speeds
        if frame.smallest.shape[1]:
            frame.smallest[place] = -info["constraint_values"]
            frame.at_end[place] = list(info["margins_sampled"].values())
            frame.violated[place] = self._environments[place].violated


class Setup:
    """The parts that episodes of one scenario have in common, whatever their seed.

    Attributes:
        assembly: the parts of the scenario.
        margins: its limits.
        actions: what actions mean.
        rows: (K + 1 + n, 4) the filtered reference x, y, z [m], yaw [rad], to n periods after the end.
        state: (12,) the state at t = 0.
        speeds: (4,) the rotor speeds at t = 0 [rad/s].
        periods: K, of an episode.
        loss: (4,) limits of `quadsim.flight.phase.CRITERIA`, infinite where there is none.
        sensed: whether sensors give the state.
        drawn: whether an episode's seed matters.
        spares: plants and autopilots that have flown such episodes, and are free.
    """

    def __init__(self, assembly: Assembly, action: str, preview: int) -> None:
        scenario = assembly.scenario
        self.assembly = assembly
        self.margins = Margins(assembly.limits, scenario.plant.timestep)
        self.actions = Actions(action, scenario, assembly.vehicle)
        self.periods = scenario.periods
        self.rows = assembly.followed().first(self.periods + 1 + preview)
        self.state = assembly.initial_state(assembly.motion)
        self.speeds = assembly.initial_speeds
        self.limits_of_loss = scenario.lost.limits
        self.loss = np.array([self.limits_of_loss.get(name, np.inf) for name in CRITERIA])
        self.sensed = bool(assembly.sensors) or bool(assembly.faults)
        effects = assembly.effects
        disturbed = effects.disturbance is not None or effects.thrust_noise is not None
        self.drawn = disturbed or self.sensed or assembly.moving_air is not None or bool(scenario.forces)
        self.spares: list[_Slot] = []


@dataclass
class _Slot:
    """The plant, autopilot and navigation of an environment."""

    setup: Setup
    plant: Plant
    autopilot: Autopilot | None
    navigation: Navigation | None = field(default=None)


class Together:
    """Vehicles that the core flies at once; see `obstacle_to_batch`."""

    def __init__(
        self, single: QuadrotorEnv, count: int, *, rewards: RewardHook, margins: bool, most: int | None, threads: int
    ) -> None:
        """Set up as `single` is; `most` periods end an episode where that is before its scenario's end."""
        base = single.episodes.base
        self._episodes = single.episodes
        self._action = single.actions.kind
        self._preview = single.preview
        self._observations = single.observations
        self._rewards = rewards
        self._most = most
        self._names = single.constraint_names
        self._margined = margins
        self._period = base.control_period
        self._setups: OrderedDict[int | None, Setup] = OrderedDict()
        self._slots: list[_Slot | None] = [None] * count
        self._sensed: list[int] = []
        limits = 0
        if margins:
            limits = len(self._names)
        self._batch = PlantBatch(count, steps=base.steps_per_period, limits=limits, threads=threads)
        first = self._setup(Episode(scenario=base, flight=None, draw={}), key=None)
        if self._episodes.varied:  # a reference for each environment
            self._rows = np.repeat(first.rows[None], count, axis=0)
            self._table = np.arange(count)
        else:
            self._rows = np.repeat(first.rows[None], 1, axis=0)
            self._table = np.zeros(count, int)
        self._ahead = np.arange(1 + self._preview)
        self._scale = {}
        for name, values in first.actions.scale.items():
            self._scale[name] = np.repeat(values[None], count, axis=0)
        self._k = np.zeros(count, int)
        self._periods = np.full(count, first.periods)
        self._turns = np.full(count, np.nan)
        self._lowest = np.zeros(count)
        self._loss = np.full((count, len(CRITERIA)), np.inf)
        self._tolerances = np.zeros((2, count, limits))
        self._required = np.zeros((count, limits), bool)
        self._state = np.zeros((count, 12))
        self._followed = np.zeros((count, 1 + self._preview, 4))

    def close(self) -> None:
        """See `Fleet`."""
        self._batch.close()

    # --- reset -------------------------------------------------------------------------------------------------------

    def reset(self, episodes: Mapping[int, Episode], frame: StepResults) -> None:
        """See `Fleet`."""
        for place, episode in episodes.items():
            self._put(place, episode)
        places = np.array([*episodes])
        self._follow(places)
        lost = self._lost(places)
        if lost:
            raise next(iter(lost.values()))
        frame.observations[places] = self._observe(places)
        frame.rewards[places] = 0.0
        frame.time[places] = 0.0
        frame.terminated[places] = False
        frame.truncated[places] = False
        frame.phases[places] = str(Phase.FLYING)
        frame.reasons[places] = ""
        self._fill_margins(places, frame)

    def _put(self, place: int, episode: Episode) -> None:
        """Put the vehicle of an episode at its start."""
        setup = self._setup(episode, key=episode.flight)
        slot = self._slot(place, setup, episode)
        margins = None
        if self._margined:
            margins = setup.margins
        self._batch.put(place, slot.plant, setup.state, setup.speeds, loop=slot.autopilot, margins=margins)
        if margins is not None:
            self._tolerances[:, place] = margins.tolerances
            self._required[place] = margins.required
        if self._episodes.varied:
            for name, values in setup.actions.scale.items():
                self._scale[name][place] = values
            self._keep_rows(place, setup.rows)
        self._k[place] = 0
        self._turns[place] = np.nan
        if self._most is None:
            self._periods[place] = setup.periods
        else:
            self._periods[place] = min(setup.periods, self._most)
        self._lowest[place] = setup.state[_HEIGHT]
        self._loss[place] = setup.loss
        self._state[place] = self._batch.state[place]
        if slot.navigation is not None:
            slot.navigation.reset(slot.plant.physics, setup.speeds, yaw=float(setup.state[_YAW]))
            self._state[place] = slot.navigation.state()

    def _setup(self, episode: Episode, key: int | None) -> Setup:
        """Return the setup of an episode's scenario, which is kept for others of the same flight of the campaign."""
        setup = self._setups.get(key)
        if setup is not None:
            return setup
        scenario = episode.scenario
        obstacle = obstacle_to_batch(scenario)
        if obstacle is not None:
            raise InputError(f"flight {key} of the campaign has {obstacle}, which its scenario does not have")
        setup = Setup(self._episodes.assembly(scenario), self._action, self._preview)
        if scenario.control_period != self._period or scenario.steps_per_period != self._batch.steps:
            raise InputError(f"flight {key} of the campaign has another control period or physics step than others")
        names = tuple(limit.name for limit in setup.margins.limits)
        if names != self._names:
            raise InputError(f"flight {key} of the campaign has the constraints {names}, others {self._names}")
        self._setups[key] = setup
        if len(self._setups) > MOST_SETUPS:
            self._setups.popitem(last=False)
        return setup

    def _slot(self, place: int, setup: Setup, episode: Episode) -> _Slot:
        """Return the parts that fly an episode: those of the last one with new draws, if they are built the same."""
        slot = self._slots[place]
        assembly = setup.assembly.of(episode.scenario)
        forces = bool(episode.scenario.forces)  # which are built with draws of their own
        if slot is None or slot.setup is not setup or forces:
            if slot is not None and not forces:
                slot.setup.spares.append(slot)
            if setup.spares:
                slot = setup.spares.pop()
            else:
                slot = _Slot(setup, assembly.plant(), setup.actions.autopilot())
            self._slots[place] = slot
        if setup.drawn:
            slot.plant.redraw(assembly.generator("disturbance"), assembly.wind())
        if slot.autopilot is not None:
            slot.autopilot.reset()
        if setup.sensed:
            slot.navigation = assembly.navigation()
        self._sensed = [i for i, other in enumerate(self._slots) if other is not None and other.setup.sensed]
        return slot

    def _keep_rows(self, place: int, rows: Array) -> None:
        """Keep a reference, with its last row repeated up to the length of the longest."""
        longer = len(rows) - self._rows.shape[1]
        if longer > 0:
            last_rows = np.repeat(self._rows[:, -1:], longer, axis=1)
            self._rows = np.concatenate([self._rows, last_rows], axis=1)
        self._rows[place, : len(rows)] = rows
        self._rows[place, len(rows) :] = rows[-1]

    # --- step --------------------------------------------------------------------------------------------------------

    def step(self, actions: Array, flying: Flags, frame: StepResults) -> None:
        """See `Fleet`."""
        batch = self._batch
        commands = action_commands(self._action, self._scale, actions, self._state[:, _YAW])
        places = self._fly(commands, flying, frame)
        self._follow(places)
        for place, error in self._lost(places).items():
            self._state[place] = batch.state[place]
            self._follow(np.array([place]))
            frame.terminated[place] = True
            frame.reasons[place] = str(error)
        frame.observations[places] = self._observe(places)
        frame.time[:] = self._k * self._period
        self._fill_margins(places, frame)
        margins = dict(zip(self._names, frame.smallest.T, strict=False))
        rewards = self._rewards.of_many(batch.state.copy(), self._followed[:, 0].copy(), batch.acting.copy(), margins)
        frame.rewards[places] = rewards[places]
        frame.truncated[places] = (self._k[places] >= self._periods[places]) & ~frame.terminated[places]

    def _fly(self, commands: Array, flying: Flags, frame: StepResults) -> NDArray[np.intp]:
        """Fly a control period, with measurements where there are sensors; return the places whose flight goes on."""
        batch = self._batch
        batch.reference[:] = self._followed[:, 0]
        batch.measured[:] = self._state
        sensed = [i for i in self._sensed if flying[i]]
        for place in sensed:
            batch.sense(place, self._navigation(place).begin(batch.steps))
        if flying.all():
            ended = batch.fly(commands, None)
        else:
            ended = batch.fly(commands, flying)
        going = flying.copy()
        for place, error in ended.items():
            going[place] = False
            self._end(place, error, frame)
        places = np.flatnonzero(going)
        self._k[places] += 1
        self._state[places] = batch.state[places]
        for place in sensed:
            if going[place]:
                navigation = self._navigation(place)
                navigation.record(batch.flown(place))
                self._state[place] = navigation.state()
        return places

    def _end(self, place: int, error: FlightError, frame: StepResults) -> None:
        """Fill in the row of a place whose flight ended within the period, which is not part of it."""
        frame.observations[place] = self._observe(np.array([place]))[0]
        frame.terminated[place] = True
        frame.reasons[place] = str(error)

    def _fill_margins(self, places: NDArray[np.intp], frame: StepResults) -> None:
        """Fill in the margins of places, and which required constraints are violated."""
        if not self._margined:
            return
        smallest = self._batch.smallest[places]
        at_end = self._batch.at_end[places]
        frame.smallest[places] = smallest
        frame.at_end[places] = at_end
        tolerances = self._tolerances[:, places]
        required = self._required[places]
        frame.violated[places] = violated(tolerances, required, smallest, at_end)

    def _navigation(self, place: int) -> Navigation:
        slot = self._slots[place]
        assert slot is not None
        assert slot.navigation is not None
        return slot.navigation

    def _follow(self, places: NDArray[np.intp]) -> None:
        """Take the reference at the times of places, its yaw on the turn of theirs."""
        rows = self._rows[self._table[places, None], self._k[places, None] + self._ahead]
        turns = self._turns[places]
        self._followed[places] = follow_turns(rows, self._state[places, _YAW], turns)
        self._turns[places] = turns

    def _lost(self, places: NDArray[np.intp]) -> dict[int, FlightError]:
        """Return the places that are lost, with the reason.

        The loss of height is below the lowest reference of the episode so far.
        """
        states = self._batch.state[places]
        references = self._followed[places, 0]
        lowest = np.minimum(self._lowest[places], references[:, 2])
        self._lowest[places] = lowest
        values = np.empty((len(places), len(CRITERIA)))
        values[:, 0] = np.degrees(tilt(states))
        values[:, 1] = np.sqrt(np.square(states[:, 0:6:2] - references[:, :3]).sum(axis=1))
        values[:, 2] = lowest - states[:, _HEIGHT]
        values[:, 3] = np.sqrt(np.square(states[:, VELOCITIES]).sum(axis=1))
        near = (values > _NEAR_LOSS * self._loss[places]).any(axis=1)
        lost: dict[int, FlightError] = {}
        for i in np.flatnonzero(near).tolist():
            place = int(places[i])
            slot = self._slots[place]
            assert slot is not None
            try:
                time = float(self._k[place] * self._period)
                check_loss(slot.setup.limits_of_loss, time, states[i], references[i], float(lowest[i]))
            except FlightError as error:
                lost[place] = error
        return lost

    def _observe(self, places: NDArray[np.intp]) -> Array:
        previews = self._followed[places, 1:]
        acting = self._batch.acting[places]
        return self._observations.of_many(self._state[places], previews, acting)
