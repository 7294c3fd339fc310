"""A random agent in moving air, behind the robust MPC as a safety filter: `python examples/safety_filter.py`."""

import sys

import gymnasium
import numpy as np

import quadsim
import quadsim.gym

AIR = ("gust", "steady-wind", "turbulence")
"""The scenarios of the library in moving air, each with an AscTec Hummingbird."""
LARGEST = 5.0  # deg, of tilt: of roll and pitch each, that is 3.5
CONTROLLER = {
    "type": "robust",
    "horizon": 40,
    "heading": True,
    "offset_free": {},  # estimates the wind
    "tightening": {},  # so that the bounds hold between samples, and where the model errs
    "output_weights": {"x": 10.0, "y": 10.0, "z": 100.0, "yaw": 100.0},
    "input_weights": {"speed": 9e-4},
    "input_bounds": {"speed": [400.0, 510.0], "slew": [-60.0, 60.0]},  # rad/s; hover is 453
    "output_bounds": {
        "roll": [-3.5, 3.5],  # deg
        "pitch": [-3.5, 3.5],
        "roll_rate": [-20.0, 20.0],  # deg/s
        "pitch_rate": [-20.0, 20.0],
        "yaw_rate": [-60.0, 60.0],
        "vz": [-1.0, 1.0],  # m/s
    },
}


def filtered_air(name: str) -> quadsim.Scenario:
    """A scenario in moving air with that controller, and the bound on tilt as its one constraint."""
    tilt = {"name": "tilt", "signal": "tilt", "upper": LARGEST}
    return quadsim.load(name).replace({"controller": CONTROLLER, "constraints": [tilt]})


def fly(name: str, *, filtered: bool) -> None:
    """Fly one episode by random actions, and print how it went."""
    env: gymnasium.Env[np.ndarray, np.ndarray] = quadsim.gym.make_env(filtered_air(name))
    if filtered:
        env = quadsim.gym.MPCSafetyFilter(env)
    env.reset(seed=0)
    env.action_space.seed(0)
    steps = 0
    largest = 0.0
    terminated = False
    truncated = False
    while not (terminated or truncated):
        _, _, terminated, truncated, info = env.step(env.action_space.sample())
        steps += 1
        largest = max(largest, LARGEST - info["margins"]["tilt"])
    outcome = "flown"
    if terminated:
        outcome = "lost"
    filtering = "no filter"
    if isinstance(env, quadsim.gym.MPCSafetyFilter):
        filtering = f"stepped in {env.interventions} times"
    print(f"{name}: {steps} steps, tilt up to {largest:.2f} deg, {outcome}; {filtering}")
    env.close()


def main(names: list[str]) -> None:
    """One episode of each, with the filter and without."""
    for name in names or AIR:
        fly(name, filtered=True)
        fly(name, filtered=False)


if __name__ == "__main__":
    main(sys.argv[1:])
