"""Scenarios as Gymnasium environments.

    import gymnasium
    import quadsim.gym

    env = gymnasium.make("quadsim/PaperConstrained-v0")

Importing this module registers an id for each library scenario, and for each task of `TASKS`; `make_env` makes an
environment from any other scenario.
"""

from __future__ import annotations

import importlib
from importlib.util import find_spec
from typing import TYPE_CHECKING

from quadsim.errors import MissingPackageError

if TYPE_CHECKING:
    from quadsim.features.gym.environment import QuadrotorEnv as QuadrotorEnv
    from quadsim.features.gym.making import environment_id as environment_id
    from quadsim.features.gym.making import make_env as make_env
    from quadsim.features.gym.making import make_vec as make_vec
    from quadsim.features.gym.safety import MPCSafetyFilter as MPCSafetyFilter
    from quadsim.features.gym.tasks import TASKS as TASKS
    from quadsim.features.gym.vector import QuadrotorVectorEnv as QuadrotorVectorEnv

__all__ = ["TASKS", "MPCSafetyFilter", "QuadrotorEnv", "QuadrotorVectorEnv", "environment_id", "make_env", "make_vec"]

if find_spec("gymnasium") is None:
    raise MissingPackageError("quadsim.gym", "gymnasium", extra="gym")
_MODULES = {
    "MPCSafetyFilter": "safety",
    "QuadrotorEnv": "environment",
    "QuadrotorVectorEnv": "vector",
    "TASKS": "tasks",
    "environment_id": "making",
    "make_env": "making",
    "make_vec": "making",
}
for _name, _module in _MODULES.items():
    globals()[_name] = getattr(importlib.import_module(f"quadsim.features.gym.{_module}"), _name)
importlib.import_module("quadsim.features.gym.making").register_library()
importlib.import_module("quadsim.features.gym.tasks").register_tasks()
