"""Environments by name: the id of each scenario of the library, and `make_env` and `make_vec` for any other.

An id is `quadsim/` and the name in capitals, `hummingbird-figure-eight` -> `quadsim/HummingbirdFigureEight-v0`;
`import quadsim.gym` registers them, so that `gymnasium.make` builds the environments of `environment.py`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
from gymnasium.envs.registration import EnvSpec

from quadsim.features.gym.environment import QuadrotorEnv
from quadsim.features.gym.episodes import Variation
from quadsim.features.gym.vector import QuadrotorVectorEnv
from quadsim.scenarios.catalogue import scenario_names
from quadsim.scenarios.loading import load_scenario
from quadsim.scenarios.schema.bases import read_scenario
from quadsim.scenarios.schema.scenario import Scenario


def environment_id(name: str) -> str:
    """Return the id of a scenario of that name.

    Examples:
        >>> import quadsim.gym
        >>> quadsim.gym.environment_id("hummingbird-figure-eight")
        'quadsim/HummingbirdFigureEight-v0'
    """
    words = name.replace("_", "-").replace(".", "-").split("-")
    capitalised = [word[:1].upper() + word[1:] for word in words]
    return f"quadsim/{''.join(capitalised)}-v0"


def register_library() -> None:
    """Register the shipped scenarios, without checking them."""
    for name in scenario_names():
        scenario = Scenario.parse(read_scenario(name))
        gymnasium.registry.setdefault(environment_id(name), _specification(scenario, scenario=name))


def _specification(flown_scenario: Scenario, vary: Variation | None = None, **kwargs: Any) -> EnvSpec:
    """Return the specification; its time limit is the duration, unless a campaign gives each episode its own."""
    time_limit = None
    if vary is None:
        time_limit = flown_scenario.periods
    return EnvSpec(
        environment_id(flown_scenario.name),
        f"{QuadrotorEnv.__module__}:{QuadrotorEnv.__name__}",
        max_episode_steps=time_limit,
        kwargs=kwargs,
        vector_entry_point=f"{QuadrotorVectorEnv.__module__}:{QuadrotorVectorEnv.__name__}",
    )


def make_env(scenario: Scenario | str | Path, **options: Any) -> gymnasium.Env[Any, Any]:
    """Return the environment of any scenario, with the wrappers of `gymnasium.make`: its time limit is the duration.

    With `vary` each episode ends at its own duration; `gymnasium.make` of a registered id keeps the limit of the
    scenario that ships, and takes another as `max_episode_steps`.

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
    scenario = load_scenario(scenario)
    return gymnasium.make(_specification(scenario, options.get("vary"), scenario=scenario), **options)


def make_vec(scenario: Scenario | str | Path, num_envs: int, **options: Any) -> QuadrotorVectorEnv:
    """Make N environments of a scenario, or of a file or name, which the core flies together in this process.

    Args:
        scenario: it, or its name or file.
        num_envs: N.
        options: what `QuadrotorVectorEnv` takes: `action`, `observation`, `preview`, `vary`, `reward`, `margins`,
            `autoreset_mode`, `threads`.

    Raises:
        InputError: the scenario or an option is not possible.

    Examples:
        >>> import quadsim.gym
        >>> envs = quadsim.gym.make_vec("hover", 2)
        >>> envs.reset(seed=7)[0].shape, str(envs.metadata["autoreset_mode"])
        ((2, 216), 'AutoresetMode.NEXT_STEP')
        >>> envs.close()
    """
    scenario = load_scenario(scenario)
    envs = QuadrotorVectorEnv(scenario, num_envs, **options)
    specification = _specification(scenario, options.get("vary"), scenario=scenario)
    specification.kwargs |= {**options, "num_envs": num_envs}
    envs.spec = specification
    return envs
