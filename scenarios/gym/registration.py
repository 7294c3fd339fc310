"""The environments' ids, one per scenario of the library, and environments of any scenario."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import gymnasium
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import VectorEnv

from quadsim.errors import ParameterError
from scenarios.api import as_scenario
from scenarios.schema.bases import read_scenario
from scenarios.schema.scenario import Scenario
from scenarios.shipped import scenario_names, scenario_path

ENTRY_POINT: Final = "scenarios.gym.environment:QuadrotorEnv"


def environment_id(name: str) -> str:
    """The id of a scenario of that name.

    Examples:
        >>> import quadsim.gym
        >>> quadsim.gym.environment_id("hummingbird-figure-eight")
        'quadsim/HummingbirdFigureEight-v0'
    """
    words = name.replace("_", "-").replace(".", "-").split("-")
    return f"quadsim/{''.join(word[:1].upper() + word[1:] for word in words)}-v0"


def register_library() -> None:
    """Register the scenarios that ship; they are right, and not checked."""
    for name in scenario_names():
        scenario = Scenario.read(read_scenario(scenario_path(name), scenario_path))
        gymnasium.registry.setdefault(environment_id(name), _specification(scenario, scenario=name))


def _specification(flown: Scenario, **kwargs: Any) -> EnvSpec:
    return EnvSpec(environment_id(flown.name), ENTRY_POINT, max_episode_steps=flown.periods, kwargs=kwargs)


def make_env(scenario: Scenario | str | Path, **options: Any) -> gymnasium.Env[Any, Any]:
    """The environment of any scenario, with the wrappers of `gymnasium.make`: its time limit is the duration.

    Args:
        scenario: it, or its name or file.
        options: what `QuadrotorEnv` takes: `action`, `observation`, `preview`, `vary`, `reward`, `render_mode`, ...

    Raises:
        InputError: the scenario or an option is not possible.

    Examples:
        >>> import quadsim.gym
        >>> env = quadsim.gym.make_env("hover", action="speeds", observation=("state",))
        >>> observation, info = env.reset(seed=7)
        >>> observation.shape, env.spec.max_episode_steps, info["constraint_violation"]
        ((12,), 200, 0)
        >>> env.close()
    """
    scenario = as_scenario(scenario)
    return gymnasium.make(_specification(scenario, scenario=scenario), **options)


def make_vec(scenario: Scenario | str | Path, num_envs: int, **options: Any) -> VectorEnv:
    """The same several times over, each in a process of its own; an episode's end is reset in the next step.

    Args:
        scenario: it, or its name or file.
        num_envs: how many.
        options: as of `make_env`.

    Raises:
        InputError: as of `make_env`.

    Examples:
        >>> import quadsim.gym
        >>> envs = quadsim.gym.make_vec("hover", 2)
        >>> envs.reset(seed=7)[0].shape, str(envs.metadata["autoreset_mode"])
        ((2, 216), 'AutoresetMode.NEXT_STEP')
        >>> envs.close()
    """
    if num_envs < 1:
        raise ParameterError("", "num_envs", num_envs, "at least 1")
    scenario = as_scenario(scenario)
    return gymnasium.make_vec(_specification(scenario, scenario=scenario), num_envs, "async", **options)
