"""Scenarios as Gymnasium environments.

    import gymnasium
    import quadsim.gym

    env = gymnasium.make("quadsim/PaperConstrained-v0")

Importing this module registers an id for each scenario of the library; `make_env` makes an environment of any other.
"""

from __future__ import annotations

import importlib
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from quadsim.errors import MissingPackageError

if TYPE_CHECKING:
    from scenarios.gym.environment import QuadrotorEnv as QuadrotorEnv
    from scenarios.gym.registration import environment_id as environment_id
    from scenarios.gym.registration import make_env as make_env
    from scenarios.gym.registration import make_vec as make_vec
    from scenarios.gym.safety import MPCSafetyFilter as MPCSafetyFilter

_MODULES = {
    "MPCSafetyFilter": "scenarios.gym.safety",
    "QuadrotorEnv": "scenarios.gym.environment",
    "environment_id": "scenarios.gym.registration",
    "make_env": "scenarios.gym.registration",
    "make_vec": "scenarios.gym.registration",
}
__all__ = [*_MODULES]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used."""
    if name not in _MODULES:
        raise AttributeError(f"module 'quadsim.gym' has no attribute {name!r}")
    return globals().setdefault(name, getattr(importlib.import_module(_MODULES[name]), name))


def __dir__() -> list[str]:
    """The public names, imported or not."""
    return sorted({*globals(), *_MODULES})


def _register() -> None:
    if find_spec("gymnasium") is None:
        raise MissingPackageError("quadsim.gym", "gymnasium", extra="gym")
    from scenarios.gym.registration import register_library

    register_library()


_register()
