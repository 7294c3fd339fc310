"""A policy that `ppo.py` has learned, and its flight as a controller: `quadsim run examples/ppo_flight.toml`."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import quadsim.gym
from quadsim.controller import COMMANDED, Command, StepInputs
from quadsim.vehicle import Vehicle

Array = NDArray[Any]

TASK = "quadsim/TrackEight-v0"
LARGEST_INPUT = 10.0  # of the network, in deviations
DIGITS = 6  # of the numbers in a file


@dataclass(frozen=True, kw_only=True)
class Policy:
    """A network of tanh units from an observation (n,) to an action (4,).

        h_0 = (observation - mean) / deviation,    h_i = tanh(h_(i-1) W_i + b_i),    action = h W + b

    The layers are pairs of W and b; the last has no tanh.
    """

    mean: Array  # (n,) of the observations that it was trained on
    deviation: Array  # (n,) their standard deviation
    layers: tuple[tuple[Array, Array], ...]

    def normalised(self, observation: Array) -> Array:
        """Return the network's inputs (..., n) for observations (..., n)."""
        inputs = (observation - self.mean) / self.deviation
        return np.clip(inputs, -LARGEST_INPUT, LARGEST_INPUT)

    def action(self, observation: Array) -> Array:
        """Return the actions (..., 4), in [-1, 1], for observations (..., n)."""
        hidden = self.normalised(observation)
        for weights, bias in self.layers[:-1]:
            hidden = np.tanh(hidden @ weights + bias)
        weights, bias = self.layers[-1]
        return np.clip(hidden @ weights + bias, -1.0, 1.0).astype(np.float32)

    def save(self, path: Path) -> None:
        """Write it as JSON."""
        layers = []
        for weights, bias in self.layers:
            layers.append({"weights": rounded(weights), "bias": rounded(bias)})
        data = {"mean": rounded(self.mean), "deviation": rounded(self.deviation), "layers": layers}
        path.write_text(json.dumps(data) + "\n", encoding="utf-8")

    @staticmethod
    def load(path: Path) -> Policy:
        """Read what `save` wrote."""
        data = json.loads(path.read_text(encoding="utf-8"))
        layers = []
        for layer in data["layers"]:
            layers.append((np.array(layer["weights"]), np.array(layer["bias"])))
        return Policy(mean=np.array(data["mean"]), deviation=np.array(data["deviation"]), layers=tuple(layers))


def rounded(array: Array) -> Any:
    """Return an array as nested lists of numbers with `DIGITS` digits."""
    if array.ndim > 1:
        return [rounded(row) for row in array]
    return [float(f"{number:.{DIGITS}g}") for number in array.tolist()]


class LearnedController:
    """A learned policy in the place of an MPC: it observes and acts as in its task.

    The environment of the task, which flies nothing here, translates: measured state and reference to the observation,
    and the action to thrust and body rates for the rate loop.
    """

    name = "PPO"

    def __init__(self, vehicle: Vehicle, period: float, horizon: int, file: str = "ppo_policy.json") -> None:
        """Load the policy from a file, whose path is relative to this module's folder."""
        self.policy = Policy.load(Path(__file__).parent / file)
        task = quadsim.gym.QuadrotorEnv(**quadsim.gym.TASKS[TASK])
        self.observations = task.observations
        self.actions = task.actions
        self.preview = quadsim.gym.TASKS[TASK]["preview"]
        self.horizon = horizon

    def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
        """Return the command for a measured state (12,) and the samples of the reference that follow, (N, 4)."""
        assert now.acting is not None
        observation = self.observations.of(np.asarray(state), reference[: self.preview], now.acting)
        command = self.actions.command(self.policy.action(observation), self.horizon)
        return replace(command, status=COMMANDED)
