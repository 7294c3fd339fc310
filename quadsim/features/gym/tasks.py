"""Tasks: scenarios with an action, an observation, draws and a reward chosen for learning, registered by an id.

A task is a set of arguments of `make_env` and `make_vec` (`making.py`); `examples/ppo.py` learns `TrackEight`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec

from quadsim.features.gym.environment import QuadrotorEnv
from quadsim.features.gym.vector import QuadrotorVectorEnv
from quadsim.state import EULER, REFERENCE_STATES, Array, wrapped

PRECISION: Final = 3.0
"""Decrease of the logarithm of the reward per metre of distance from the reference [1/m]."""
GENTLE_TILT: Final = math.radians(13.5)
"""Roll and pitch up to which the reward is free [rad]; the scenario's bound is 15 deg, and the course needs 13."""
TILT_COST: Final = math.degrees(1.0)
"""Decrease of the logarithm of the reward per radian beyond `GENTLE_TILT`: 1 per degree."""


def tracking_reward(state: Array, reference: Array, speeds: Array) -> Array:
    """Return the reward of tracking, in (0, 1]: less by distance, error of yaw, and roll or pitch beyond a bound.

        exp(-PRECISION |p - p_ref| - |yaw - yaw_ref| - TILT_COST (excess of |roll| + excess of |pitch|)),

    an excess being what is beyond `GENTLE_TILT`.  It is never negative, so ending an episode early never pays.

    Args:
        state: (..., 12) true state after a step; leading dimensions are those of a batch.
        reference: (..., 4) x, y, z [m], yaw [rad] at the same time.
        speeds: rotor speeds, which cost nothing here.

    Examples:
        >>> import numpy as np
        >>> from quadsim.features.gym.tasks import tracking_reward
        >>> tracking_reward(np.zeros((2, 12)), np.zeros((2, 4)), np.zeros((2, 4)))
        array([1., 1.])
    """
    error = state[..., list(REFERENCE_STATES)] - reference
    distance = np.linalg.norm(error[..., :3], axis=-1)
    yaw_error = np.abs(wrapped(error[..., 3]))
    tilts = np.abs(state[..., list(EULER[:2])])
    excess = np.maximum(tilts - GENTLE_TILT, 0.0).sum(axis=-1)
    return np.asarray(np.exp(-PRECISION * distance - yaw_error - TILT_COST * excess))


TASKS: Final[Mapping[str, Mapping[str, Any]]] = MappingProxyType(
    {
        "quadsim/TrackEight-v0": MappingProxyType(
            {
                "scenario": "hummingbird-figure-eight",
                "action": "rates",
                "observation": ("ahead", "state"),
                "preview": 10,
                "vary": "track-eight",
                "reward": tracking_reward,
            }
        )
    }
)
"""The arguments of `make_env` and `make_vec` for each task, by its id: `make_env(**TASKS[id])`."""


def register_tasks() -> None:
    """Register the tasks, without checking their scenarios."""
    single = f"{QuadrotorEnv.__module__}:{QuadrotorEnv.__name__}"
    many = f"{QuadrotorVectorEnv.__module__}:{QuadrotorVectorEnv.__name__}"
    for name, arguments in TASKS.items():
        specification = EnvSpec(name, single, kwargs=dict(arguments), vector_entry_point=many)
        gymnasium.registry.setdefault(name, specification)
