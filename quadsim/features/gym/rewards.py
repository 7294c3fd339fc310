"""Rewards of a step: the default, exp(-distance - |yaw error|), or any function of state, reference and speeds.

`RewardHook` checks the function once; `environment.py` calls it for one environment, `fleet.py` for N at once.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from quadsim.errors import ParameterError
from quadsim.state import REFERENCE_STATES, Array, wrapped

Reward = Callable[..., Any]
"""Function of the true state (..., 12) after a step, the reference (..., 4) and the commanded rotor speeds (..., 4)
[rad/s]; where it has a parameter `margins`, also of the margins within the step by the names of the constraints, (...)
each.

An environment calls it without the leading axis, a vector of N environments with one of N, for N rewards: a function
written with `[..., i]` serves both.
"""


def nearness(state: Array, reference: Array, speeds: Array) -> Array:
    """Default reward, exp(-d) in (0, 1], with d the distance from the reference [m] plus the yaw error [rad].

    It is never negative, so ending an episode early never pays.
    """
    error = state[..., REFERENCE_STATES] - reference
    distance = np.sqrt(np.square(error[..., :3]).sum(axis=-1))
    reward: Array = np.exp(-distance - np.abs(wrapped(error[..., 3])))
    return reward


class RewardHook:
    """A reward function, called with the margins where it takes them.

    Attributes:
        takes_margins: whether it has a parameter `margins`.
    """

    def __init__(self, reward: Reward) -> None:
        """Wrap a function.

        Raises:
            ParameterError: it cannot be called with state, reference and speeds.
        """
        self._reward = reward
        rule = "a function of state, reference and speeds, and of margins where it has a parameter of that name"
        if not callable(reward):
            raise ParameterError("", "reward", reward, rule)
        try:
            signature = inspect.signature(reward)
        except (TypeError, ValueError):  # compiled, without a signature
            self.takes_margins = False
            return
        self.takes_margins = "margins" in signature.parameters
        keywords: dict[str, None] = {}
        if self.takes_margins:
            keywords["margins"] = None
        try:
            signature.bind(None, None, None, **keywords)
        except TypeError:
            raise ParameterError("", "reward", f"{getattr(reward, '__name__', '')}{signature}", rule) from None

    def of_one(self, state: Array, reference: Array, speeds: Array, margins: Mapping[str, float]) -> float:
        """Return the reward of an environment.

        Raises:
            ParameterError: the function returned something else.
        """
        reward = self._call(state, reference, speeds, margins)
        if reward is None or np.ndim(reward) > 0:
            raise ParameterError("", "reward", reward, "a function that returns one number for one environment")
        return float(reward)

    def of_many(self, states: Array, references: Array, speeds: Array, margins: Mapping[str, Array]) -> Array:
        """Return N rewards.

        Raises:
            ParameterError: the function returned something else.
        """
        rewards = np.array(self._call(states, references, speeds, margins), np.float64)
        if rewards.shape != (len(states),):
            rule = f"of shape ({len(states)},), one for each environment: index with [..., i]"
            raise ParameterError("reward", "shape", rewards.shape, rule)
        return rewards

    def _call(self, states: Array, references: Array, speeds: Array, margins: Mapping[str, Any]) -> Any:
        if self.takes_margins:
            return self._reward(states, references, speeds, margins=margins)
        return self._reward(states, references, speeds)
