"""How fast crazyflow steps; `make_gym.py --crazyflow PYTHON` calls this with an interpreter that has it."""

from __future__ import annotations

import json
import sys
import time

import numpy as np
from crazyflow.dynamics import Dynamics
from crazyflow.envs.reach_pos_env import ReachPosEnv

RATE = 20


def real_time_factor(worlds: int, steps: int) -> float:
    """Simulated seconds of all worlds per second of processor time; rotor dynamics from first principles."""
    env = ReachPosEnv(num_envs=worlds, freq=RATE, dynamics=Dynamics.first_principles)
    env.reset(seed=0)
    action = np.broadcast_to(env.action_space.low + env.action_space.high, env.action_space.shape) * 0.5
    for _ in range(5):
        env.step(action)
    started = time.process_time()
    for _ in range(steps):
        observed = env.step(action)[0]
    np.asarray(observed["pos"])
    return worlds * steps / RATE / (time.process_time() - started)


if __name__ == "__main__":
    print(json.dumps({str(worlds): real_time_factor(worlds, 400) for worlds in map(int, sys.argv[1:])}))
