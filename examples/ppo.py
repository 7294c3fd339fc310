"""PPO learns to stop and hold a place by thrust and body rates: `python examples/ppo.py`, five minutes on one core.

    pip install -r examples/ppo-requirements.txt

Each episode of `ppo.toml` starts tilted and on the move; its return is the sum of 200 rewards, of 1 each at the place
itself.  The MPC of the scenario, and doing nothing, fly the same seeded episodes as the policy that was learned.

`--out` gets the learning curve (`curve.csv`, `curve.png`), how all three did (`evaluation.csv`), and the policy with
the mean and deviation of what it observes (`policy.zip`, `normalisation.pkl`).
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import gymnasium
import numpy as np
from numpy.typing import NDArray

import quadsim.gym
from quadsim.palette import COLOUR
from quadsim.report.figure import Figure, Panel, Series
from quadsim.report.to_matplotlib import write_figure

SCENARIO, EPISODES = "hummingbird-figure-eight", Path(__file__).with_name("ppo.toml")
ENVIRONMENTS = 8  # side by side, in one process
GAMMA = 0.98
FIRST_SEED = 1_000_000  # of evaluation; training counts from 0
Array = NDArray[Any]
Env: TypeAlias = gymnasium.Env[Any, Any]
Row = TypeVar("Row")
Policy = Callable[[Env, Array], Array]
"""The action for an environment and its observation."""


@dataclass(frozen=True, kw_only=True)
class Rollout:
    """A point of the learning curve."""

    steps: int  # so far, of all environments
    seconds: float  # so far, of one core [s]
    mean_return: float  # of the episodes that ended in this rollout, flown with exploration


@dataclass(frozen=True, kw_only=True)
class Score:
    """What a policy does in seeded episodes."""

    policy: str
    episodes: int
    mean_return: float
    least_return: float
    lost: int  # episodes that ended before their time
    error: float  # RMS distance from the place over all periods flown [m]


def make_env(action: str = "rates") -> Env:
    """The task: observe place and yaw relative to the next reference, and the state; command thrust and body rates."""
    return quadsim.gym.make_env(SCENARIO, action=action, observation=("ahead", "state"), preview=1, vary=EPISODES)


def nothing(env: Env, observation: Array) -> Array:
    """Thrust of the weight, no turn."""
    return np.zeros(4, np.float32)


def mpc(env: Env, observation: Array) -> Array:
    """The scenario's controller, where actions are rotor speeds."""
    action: Array = env.unwrapped.controller_action()
    return action


def evaluate(name: str, policy: Policy, env: Env, episodes: int = 50) -> Score:
    """Fly seeded episodes, the same for every policy."""
    returns, squares, lost = [], [], 0
    for seed in range(FIRST_SEED, FIRST_SEED + episodes):
        observation, _ = env.reset(seed=seed)
        total, terminated, truncated = 0.0, False, False
        while not (terminated or truncated):
            observation, reward, terminated, truncated, _ = env.step(policy(env, observation))
            total += float(reward)
        flight = env.unwrapped.flight()
        squares.append(sum(np.square(flight.state[axis] - flight.reference[axis]) for axis in "xyz"))
        returns.append(total)
        lost += terminated
    mean, error = float(np.mean(returns)), float(np.sqrt(np.concatenate(squares).mean()))
    return Score(policy=name, episodes=episodes, mean_return=mean, least_return=min(returns), lost=lost, error=error)


def learn(steps: int) -> tuple[Any, Any, list[Rollout]]:
    """PPO on normalised observations and returns: the model, the normalisation, the learning curve."""
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

    curve: list[Rollout] = []
    start = time.process_time()

    class Curve(BaseCallback):  # type: ignore[misc]
        """Notes the returns of the episodes that end in each rollout."""

        returns: list[float] = []  # noqa: RUF012

        def _on_step(self) -> bool:
            self.returns += [info["episode"]["r"] for info in self.locals["infos"] if "episode" in info]
            return True

        def _on_rollout_end(self) -> None:
            if self.returns:
                seconds, mean = time.process_time() - start, float(np.mean(self.returns))
                curve.append(Rollout(steps=self.num_timesteps, seconds=seconds, mean_return=mean))
                print(f"{self.num_timesteps} steps, {seconds:.0f} s: mean return {mean:.1f}", flush=True)
                self.returns.clear()

    envs = VecNormalize(VecMonitor(DummyVecEnv([make_env] * ENVIRONMENTS)), gamma=GAMMA)
    model = PPO(
        "MlpPolicy",
        envs,
        n_steps=128,
        batch_size=256,
        gamma=GAMMA,
        learning_rate=lambda left: 1e-3 * max(left, 0.1),
        policy_kwargs={"log_std_init": -2.0, "net_arch": [64, 64]},  # a seventh of 6 rad/s: more tumbles at once
        seed=0,
        device="cpu",
    )
    model.learn(steps, callback=Curve())
    envs.training = False
    return model, envs, curve


def learned(model: Any, normalisation: Any) -> Policy:
    """The mean action of a model that was trained on normalised observations."""

    def policy(env: Env, observation: Array) -> Array:
        action: Array = model.predict(normalisation.normalize_obs(observation), deterministic=True)[0]
        return action

    return policy


def curve_figure(curve: Sequence[Rollout], scores: Sequence[Score]) -> Figure:
    """The learning curve, with what the other policies reach."""
    steps = np.array([rollout.steps for rollout in curve], float)
    returns = np.array([rollout.mean_return for rollout in curve])
    colours = {"MPC": COLOUR.reference, "nothing": COLOUR.measured}
    others = [
        Series(x=steps, y=np.full(steps.size, score.mean_return), colour=colours[score.policy], label=score.policy)
        for score in scores
        if score.policy in colours
    ]
    learning = Series(x=steps, y=returns, colour=COLOUR.flown, label="PPO while it learns")
    panel = Panel(
        title="return of an episode", series=(learning, *others), x_label="steps", y_range=(0.0, 200.0), height=1.6
    )
    return Figure(key="ppo", title="", panels=(panel,), columns=1)


def write_csv(path: Path, rows: Sequence[Rollout | Score]) -> None:
    """One line each, with a header."""
    with path.open("w", newline="", encoding="utf-8") as file:
        lines = csv.writer(file, lineterminator="\n")
        lines.writerow(asdict(rows[0]))
        for row in rows:
            lines.writerow(f"{x:.4g}" if isinstance(x, float) else x for x in asdict(row).values())


def read_csv(path: Path, kind: Callable[..., Row]) -> list[Row]:
    """What `write_csv` wrote."""
    with path.open(encoding="utf-8") as file:
        lines = list(csv.DictReader(file))
    return [kind(**{name: text if name == "policy" else number(text) for name, text in line.items()}) for line in lines]


def number(text: str) -> int | float:
    """A count, or another number."""
    return int(text) if text.isdigit() else float(text)


def main() -> None:
    """Learn, compare, write."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--out", type=Path, default=Path("runs/ppo"))
    arguments = parser.parse_args()
    folder: Path = arguments.out
    folder.mkdir(parents=True, exist_ok=True)
    model, normalisation, curve = learn(arguments.steps)
    model.save(folder / "policy.zip")
    normalisation.save(folder / "normalisation.pkl")
    scores = [
        evaluate("PPO", learned(model, normalisation), make_env()),
        evaluate("MPC", mpc, make_env("speeds")),
        evaluate("nothing", nothing, make_env()),
    ]
    for score in scores:
        print(score)
    write_csv(folder / "curve.csv", curve)
    write_csv(folder / "evaluation.csv", scores)
    write_figure(curve_figure(curve, scores), folder / "curve.png", width=5.5, overwrite=True)


if __name__ == "__main__":
    main()
