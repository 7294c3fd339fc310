"""PPO learns to fly a figure eight by thrust and body rates: `python examples/ppo.py`, four minutes on one core.

Proximal policy optimisation (Schulman et al., 2017, arXiv:1707.06347) with generalised advantages, in NumPy, on the
vector environment of `quadsim/TrackEight-v0`.  The policy and the scenario's MPC then fly the campaign `track-eight` on
draws of a seed that training did not use, and are audited alike.  `--out` gets the policy (`policy.json`), the learning
curve (`curve.csv`, `curve.png`), the comparison (`comparison.csv`), and both campaigns (`learned/`, `mpc/`).
"""

from __future__ import annotations

import argparse
import csv
import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray
from ppo_policy import TASK, Policy

import quadsim
import quadsim.gym
from quadsim.palette import COLOUR
from quadsim.report.figure import Bound, Figure, Panel, Series
from quadsim.report.to_matplotlib import write_figure
from quadsim.state import POSITION

Array = NDArray[Any]
Layers = list[Array]
"""Weights and biases of a network in turn: W_1, b_1, W_2, b_2, ..."""

PREVIEW = 4 * quadsim.gym.TASKS[TASK]["preview"]  # entries of an observation before those of the state
PLACES = [PREVIEW + i for i in POSITION]  # its entries x, y, z
CAMPAIGN = Path(__file__).with_name("ppo_campaign.toml")
EVALUATION_SEED = 1  # of the campaigns; the starts of training are drawn from seed 0
STEPS = 561_152  # 137 updates
CLAIM = 0.1  # RMS distance from the reference that it has to get below [m]
FLIGHTS = 40


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Numbers of the algorithm."""

    environments: int = 64  # side by side
    length: int = 64  # steps of each environment between two updates
    epochs: int = 5  # passes over these steps
    minibatch: int = 512  # steps
    units: tuple[int, ...] = (32, 32)  # of the hidden layers
    learning_rate: float = 1e-3  # at the start; it falls linearly, to `final_share` of it
    final_share: float = 0.3
    discount: float = 0.97  # gamma per period: 1.6 s
    trace: float = 0.95  # lambda of the generalised advantages
    clip: float = 0.2  # of the probability ratio
    deviation: float = 0.2  # of the actions, at the start
    largest_gradient: float = 0.5  # its norm is cut off there
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class CurvePoint:
    """A point of the learning curve."""

    steps: int  # so far, of all environments
    reward: float  # mean of a step since the point before, with exploration
    error: float  # RMS distance from the reference, likewise [m]
    lost: int  # episodes that ended early, likewise


@dataclass(frozen=True, kw_only=True)
class Score:
    """What a controller does in the campaign."""

    controller: str
    flights: int
    lost: int
    violated: int  # flights with a constraint violated, those that were lost among them
    tilted: int  # flights with the bound on roll or pitch violated
    error: float  # RMS distance from the reference, over all flights [m]
    largest_error: float  # of a flight, likewise [m]
    peak_tilt: float  # largest angle of the thrust axis to the vertical [deg]


def forward(layers: Layers, inputs: Array) -> list[Array]:
    """Return the inputs, the hidden layers and the output (K, m) of a network for inputs (K, n)."""
    values = [inputs]
    for i in range(0, len(layers), 2):
        output = values[-1] @ layers[i] + layers[i + 1]
        is_last = i == len(layers) - 2
        if not is_last:
            output = np.tanh(output)
        values.append(output)
    return values


def backward(layers: Layers, values: list[Array], slope: Array) -> Layers:
    """Return the gradient by weights and biases, from that by the output (K, m) and what `forward` returned."""
    gradient: Layers = []
    for i in range(len(layers) - 2, -1, -2):
        inputs = values[i // 2]
        gradient = [inputs.T @ slope, slope.sum(axis=0), *gradient]
        if i > 0:
            slope = (slope @ layers[i].T) * (1.0 - inputs**2)
    return gradient


def make_layers(rng: np.random.Generator, sizes: Sequence[int], last_gain: float) -> Layers:
    """Return orthogonal weights with a gain of sqrt(2), or `last_gain` in the last layer, and biases of zero."""
    layers: Layers = []
    for i in range(len(sizes) - 1):
        rows = sizes[i]
        columns = sizes[i + 1]
        orthogonal, _ = np.linalg.qr(rng.standard_normal((max(rows, columns), min(rows, columns))))
        if rows < columns:
            orthogonal = orthogonal.T
        gain = np.sqrt(2.0)
        if i == len(sizes) - 2:
            gain = last_gain
        layers.append((gain * orthogonal).astype(np.float32))
        layers.append(np.zeros(columns, np.float32))
    return layers


class Adam:
    """Gradient descent with momentum and a step size for each parameter (Kingma and Ba, 2015, arXiv:1412.6980)."""

    def __init__(self, parameters: Layers, largest_gradient: float) -> None:
        self.parameters = parameters
        self.largest_gradient = largest_gradient
        self.mean = [np.zeros_like(parameter) for parameter in parameters]
        self.square = [np.zeros_like(parameter) for parameter in parameters]
        self.count = 0

    def step(self, gradient: Layers, rate: float) -> None:
        """Change the parameters in place."""
        norm = np.sqrt(sum(float(np.square(part).sum()) for part in gradient))
        share = min(1.0, self.largest_gradient / (norm + 1e-8))
        self.count += 1
        mean_share = 1.0 - 0.9**self.count
        square_share = 1.0 - 0.999**self.count
        for parameter, part, mean, square in zip(self.parameters, gradient, self.mean, self.square, strict=True):
            mean += 0.1 * (share * part - mean)
            square += 0.001 * (np.square(share * part) - square)
            parameter -= rate * (mean / mean_share) / (np.sqrt(square / square_share) + 1e-5)


class Moments:
    """Running mean and variance of observations (n,)."""

    def __init__(self, size: int) -> None:
        self.mean = np.zeros(size)
        self.variance = np.ones(size)
        self.count = 1e-4

    def include(self, observations: Array) -> None:
        """Include observations (K, n) (Chan, Golub and LeVeque, 1983)."""
        count = len(observations)
        total = self.count + count
        change = observations.mean(axis=0) - self.mean
        self.variance = (
            self.count * self.variance + count * observations.var(axis=0) + change**2 * self.count * count / total
        ) / total
        self.mean = self.mean + change * count / total
        self.count = total


@dataclass(kw_only=True)
class Rollout:
    """Steps (T,) of environments (n,) between two updates; `values` has one more, of the observation at the end."""

    inputs: list[Array] = field(default_factory=list)  # (n, m) normalised observations
    actions: list[Array] = field(default_factory=list)  # (n, 4) with exploration
    log_probabilities: list[Array] = field(default_factory=list)  # (n,)
    rewards: list[Array] = field(default_factory=list)  # (n,)
    values: list[Array] = field(default_factory=list)  # (n,) what the value network expects
    ended: list[Array] = field(default_factory=list)  # (n,) whether the step was the last of an episode
    values_at_end: list[Array] = field(default_factory=list)  # (n,) the value beyond it: 0, unless time alone was up
    distances: list[Array] = field(default_factory=list)  # (n,) from the reference [m]
    lost: int = 0  # episodes that ended before their time


class Learner:
    """PPO on a vector environment that resets an ended episode in the same step.

    Attributes:
        curve: a point for each update.
    """

    def __init__(self, envs: VectorEnv, settings: Settings) -> None:
        """Set up networks, and reset the environments."""
        self.envs = envs
        self.settings = settings
        self.rng = np.random.default_rng(settings.seed)
        self.observed, _ = envs.reset(seed=settings.seed)
        size = self.observed.shape[1]
        self.moments = Moments(size)
        self.actor = make_layers(self.rng, (size, *settings.units, 4), 0.01)
        self.critic = make_layers(self.rng, (size, *settings.units, 1), 1.0)
        self.log_deviation = np.full(4, np.log(settings.deviation), np.float32)
        self.actor_steps = Adam([*self.actor, self.log_deviation], settings.largest_gradient)
        self.critic_steps = Adam(self.critic, settings.largest_gradient)
        self.curve: list[CurvePoint] = []

    def policy(self) -> Policy:
        """Return the policy as learned so far, without exploration."""
        layers = []
        for i in range(0, len(self.actor), 2):
            layers.append((self.actor[i].copy(), self.actor[i + 1].copy()))
        deviation = np.sqrt(self.moments.variance + 1e-8)
        return Policy(mean=self.moments.mean.copy(), deviation=deviation, layers=tuple(layers))

    def learn(self, updates: int, *, report: bool = True) -> None:
        """Fly and update; the learning rate falls over these updates."""
        for update in range(updates):
            fallen = (1.0 - self.settings.final_share) * update / updates
            rollout = self.fly()
            self.update(rollout, self.settings.learning_rate * (1.0 - fallen))
            self.note(rollout)
            if report and (update % 20 == 19 or update == updates - 1):
                point = self.curve[-1]
                learned = f"reward {point.reward:.3f}, RMS error {point.error:.3f} m, {point.lost} episodes lost"
                print(f"{point.steps} steps: {learned}", flush=True)

    def fly(self) -> Rollout:
        """Fly `length` steps of each environment by the policy, with exploration."""
        rollout = Rollout()
        policy = self.policy()
        deviation = np.exp(self.log_deviation)
        seen = []
        for _ in range(self.settings.length):
            seen.append(self.observed)
            references = self.observed[:, :3] + self.observed[:, PLACES]  # one period ahead
            inputs = policy.normalised(self.observed).astype(np.float32)
            noise = self.rng.standard_normal((len(inputs), 4)).astype(np.float32)
            actions = forward(self.actor, inputs)[-1] + deviation * noise
            rollout.inputs.append(inputs)
            rollout.actions.append(actions)
            rollout.log_probabilities.append(np.sum(-0.5 * noise**2 - self.log_deviation, axis=1))
            rollout.values.append(forward(self.critic, inputs)[-1][:, 0])
            stepped = self.envs.step(np.clip(actions, -1.0, 1.0))
            self.observed, rewards, terminated, truncated, infos = stepped
            ended = terminated | truncated
            at_end = np.zeros(len(inputs))
            last_observed = self.observed.copy()
            for i in np.flatnonzero(ended):
                last_observed[i] = infos["final_obs"][i]
            if truncated.any():
                last_inputs = policy.normalised(last_observed[truncated]).astype(np.float32)
                at_end[truncated] = forward(self.critic, last_inputs)[-1][:, 0]
            rollout.rewards.append(rewards)
            rollout.ended.append(ended)
            rollout.values_at_end.append(at_end)
            rollout.distances.append(np.linalg.norm(last_observed[:, PLACES] - references, axis=1))
            rollout.lost += int(terminated.sum())
        inputs = policy.normalised(self.observed).astype(np.float32)
        rollout.values.append(forward(self.critic, inputs)[-1][:, 0])
        self.moments.include(np.concatenate(seen))
        return rollout

    def advantages(self, rollout: Rollout) -> Array:
        """Return the generalised advantages (T, n) (Schulman et al., 2016, arXiv:1506.02438).

            delta_t = (1 - gamma) r_t + gamma V_(t+1) - V_t,    A_t = delta_t + gamma lambda A_(t+1)

        Values are thereby means of rewards over the discounted time ahead; after an episode's end there is no A.
        """
        discount = self.settings.discount
        advantages = []
        following = np.zeros(len(rollout.values[0]))
        for t in reversed(range(len(rollout.rewards))):
            ended = rollout.ended[t]
            next_value = np.where(ended, rollout.values_at_end[t], rollout.values[t + 1])
            delta = (1.0 - discount) * rollout.rewards[t] + discount * next_value - rollout.values[t]
            following = delta + discount * self.settings.trace * np.where(ended, 0.0, following)
            advantages.append(following)
        return np.array(advantages[::-1])

    def update(self, rollout: Rollout, rate: float) -> None:
        """Improve both networks by what was flown."""
        advantages = self.advantages(rollout)
        returns = np.ravel(advantages + np.array(rollout.values[:-1])).astype(np.float32)
        advantages = advantages.ravel().astype(np.float32)
        inputs = np.concatenate(rollout.inputs)
        actions = np.concatenate(rollout.actions)
        before = np.concatenate(rollout.log_probabilities)
        for _ in range(self.settings.epochs):
            order = self.rng.permutation(len(inputs))
            for first in range(0, len(order), self.settings.minibatch):
                chosen = order[first : first + self.settings.minibatch]
                self.improve_actor(inputs[chosen], actions[chosen], before[chosen], advantages[chosen], rate)
                values = forward(self.critic, inputs[chosen])
                slope = 2.0 * (values[-1] - returns[chosen, None]) / len(chosen)
                self.critic_steps.step(backward(self.critic, values, slope), rate)

    def improve_actor(self, inputs: Array, actions: Array, before: Array, advantages: Array, rate: float) -> None:
        """Step down the gradient of -mean(min(ratio A, clipped ratio A)), A normalised over the minibatch."""
        advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        values = forward(self.actor, inputs)
        deviation = np.exp(self.log_deviation)
        noise = (actions - values[-1]) / deviation
        ratio = np.exp(np.sum(-0.5 * noise**2 - self.log_deviation, axis=1) - before)
        clip = self.settings.clip
        is_clipped = ((advantages > 0.0) & (ratio > 1.0 + clip)) | ((advantages < 0.0) & (ratio < 1.0 - clip))
        weight = np.where(is_clipped, 0.0, -advantages * ratio / len(inputs))[:, None].astype(np.float32)
        gradient = backward(self.actor, values, weight * noise / deviation)
        by_log_deviation = np.sum(weight * (noise**2 - 1.0), axis=0)
        self.actor_steps.step([*gradient, by_log_deviation], rate)

    def note(self, rollout: Rollout) -> None:
        """Add a point to the learning curve."""
        updates = len(self.curve) + 1
        steps = updates * self.settings.environments * self.settings.length
        self.curve.append(
            CurvePoint(
                steps=steps,
                reward=float(np.mean(rollout.rewards)),
                error=float(np.sqrt(np.mean(np.square(rollout.distances)))),
                lost=rollout.lost,
            )
        )


def make_envs(settings: Settings) -> VectorEnv:
    """Return the environments of the task, which reset an ended episode in the same step."""
    return quadsim.gym.make_vec(**quadsim.gym.TASKS[TASK], num_envs=settings.environments, autoreset_mode="SameStep")


def fly_campaigns(policy: Path, out: Path, flights: int) -> list[Score]:
    """Fly the campaign on unseen draws by the policy of a file, and by the MPC of the scenario."""
    options: dict[str, Any] = {"flights": flights, "seed": EVALUATION_SEED, "overwrite": True}
    file = f"controller.settings.file={policy.resolve()}"
    learned = quadsim.campaign(str(CAMPAIGN), out=out / "learned", changes=[file], **options)
    mpc = quadsim.campaign("track-eight", out=out / "mpc", **options)
    return [score("PPO", learned.table), score("MPC", mpc.table)]


def score(controller: str, table: Any) -> Score:
    """Return the score of a campaign's table."""
    verdicts = np.array(table["verdict"].to_pylist())
    violated = np.array(table["violated"].to_pylist())
    tilts = np.array(table["peak_tilt"].to_pylist())
    roll_held = np.array(table["satisfied.roll"].to_pylist(), bool)
    pitch_held = np.array(table["satisfied.pitch"].to_pylist(), bool)
    squares = []
    for axis in "xyz":
        rms = np.array(table[f"rmse.{axis}"].to_pylist(), float)
        squares.append(np.square(rms))
    errors = np.sqrt(np.sum(squares, axis=0))
    return Score(
        controller=controller,
        flights=table.num_rows,
        lost=int(np.sum(verdicts == "lost")),
        violated=int(np.sum(violated)),
        tilted=int(np.sum(~np.logical_and(roll_held, pitch_held))),
        error=float(np.sqrt(np.mean(errors**2))),
        largest_error=float(errors.max()),
        peak_tilt=float(tilts.max()),
    )


def curve_figure(curve: Sequence[CurvePoint]) -> Figure:
    """Return the learning curve: the error while it learns, with exploration."""
    steps = np.array([point.steps for point in curve], float)
    errors = np.array([100.0 * point.error for point in curve])
    series = Series(x=steps, y=errors, colour=COLOUR.flown)
    panel = Panel(
        title="RMS error while it explores [cm]",
        series=(series,),
        bounds=(Bound(value=100.0 * CLAIM),),
        x_label="steps",
        y_log=True,
        y_range=(3.0, 200.0),
        height=1.6,
    )
    return Figure(key="ppo", title="", panels=(panel,), columns=1)


def write_csv(path: Path, rows: Sequence[CurvePoint | Score]) -> None:
    """Write one line each, with a header."""
    with path.open("w", newline="", encoding="utf-8") as file:
        lines = csv.writer(file, lineterminator="\n")
        lines.writerow(asdict(rows[0]))
        for row in rows:
            cells = []
            for value in asdict(row).values():
                if isinstance(value, float):
                    cells.append(f"{value:.4g}")
                else:
                    cells.append(value)
            lines.writerow(cells)


def read_curve(path: Path) -> list[CurvePoint]:
    """Read a learning curve that `write_csv` wrote."""
    points = []
    with path.open(encoding="utf-8") as file:
        for line in csv.DictReader(file):
            points.append(
                CurvePoint(
                    steps=int(line["steps"]),
                    reward=float(line["reward"]),
                    error=float(line["error"]),
                    lost=int(line["lost"]),
                )
            )
    return points


def main() -> None:
    """Learn, compare, write."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--steps", type=int, default=STEPS, help="steps of training, of all environments")
    parser.add_argument("--flights", type=int, default=FLIGHTS, help="flights of each campaign afterwards")
    parser.add_argument("--seed", type=int, default=0, help="of networks, exploration and starts")
    parser.add_argument("--out", type=Path, default=Path("runs/ppo"))
    parser.add_argument("--policy", type=Path, help="file of the policy (default: OUT/policy.json)")
    parser.add_argument("--json", type=Path, help="also write curve and comparison there")
    arguments = parser.parse_args()
    folder: Path = arguments.out
    folder.mkdir(parents=True, exist_ok=True)
    settings = Settings(seed=arguments.seed)
    envs = make_envs(settings)
    started = time.process_time()
    learner = Learner(envs, settings)
    learner.learn(max(1, arguments.steps // (settings.environments * settings.length)))
    seconds = time.process_time() - started
    print(f"{learner.curve[-1].steps} steps took {seconds:.0f} s of one core")
    envs.close()
    policy = arguments.policy or folder / "policy.json"
    learner.policy().save(policy)
    write_csv(folder / "curve.csv", learner.curve)
    write_figure(curve_figure(learner.curve), folder / "curve.png", width=5.5, overwrite=True)
    scores = fly_campaigns(policy, folder, arguments.flights)
    for each in scores:
        print(each)
    write_csv(folder / "comparison.csv", scores)
    if arguments.json is not None:
        parts: dict[str, Any] = {"curve": [asdict(point) for point in learner.curve], "seconds": seconds}
        parts["comparison"] = [asdict(each) for each in scores]
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(json.dumps(parts), encoding="utf-8")


if __name__ == "__main__":
    main()
