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
    from quadsim.features.gym.environment import environment_id as environment_id
    from quadsim.features.gym.environment import make_env as make_env
    from quadsim.features.gym.environment import make_vec as make_vec
    from quadsim.features.gym.safety import MPCSafetyFilter as MPCSafetyFilter
    from quadsim.features.gym.tasks import TASKS as TASKS

__all__ = ["TASKS", "MPCSafetyFilter", "QuadrotorEnv", "environment_id", "make_env", "make_vec"]

if find_spec("gymnasium") is None:
    raise MissingPackageError("quadsim.gym", "gymnasium", extra="gym")
_parts = [importlib.import_module(f"quadsim.features.gym.{part}") for part in ("environment", "safety", "tasks")]
for _name in __all__:
    globals()[_name] = next(getattr(part, _name) for part in _parts if hasattr(part, _name))
_environment, _, _tasks = _parts
_environment.register_library()
_tasks.register_tasks()
