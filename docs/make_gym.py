"""Remake the numbers and the figure of docs/gym.md: `make gym`, some ten minutes; `make_gym.py speed` a part of it.

`--crazyflow PYTHON` times crazyflow beside it, with the interpreter of an environment that has it.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from make_numbers import Table, copy_figure, markdown, replace_in

import quadsim
import quadsim.gym
from quadsim.report.figures.canvas import write_drawings

HERE = Path(__file__).resolve().parent
PAGE = HERE / "gym.md"
COMMAND = "make gym"
EPISODES = 100
sys.path.insert(0, str(HERE.parent / "examples"))

from imitation import beyond, compared, learn  # noqa: E402
from safety_filter import AIR, LARGEST, filtered_air  # noqa: E402


def episode(env: gymnasium.Env[Any, Any], seed: int) -> dict[str, float]:
    """A random agent's episode: how it went, at the physics rate."""
    env.reset(seed=seed)
    env.action_space.seed(seed)
    ended, steps, correction, worst = False, 0, 0.0, np.inf
    while not ended:
        _, _, terminated, truncated, info = env.step(env.action_space.sample())
        ended, steps = terminated or truncated, steps + 1
        worst = min(worst, info["margins"]["tilt"])
        correction += info.get("filter", {"correction": 0.0})["correction"]
    stepped_in = getattr(env, "interventions", 0)
    return {"steps": steps, "lost": terminated, "margin": worst, "stepped in": stepped_in, "correction": correction}


def safety() -> Table:
    """A random agent in the library's air, with and without the filter."""
    rows: Table = [
        ("", "episodes", "tilt within 5 deg throughout", "lost", "largest tilt, deg", "stepped in", "changed by, rad/s")
    ]
    for name in ("random agent", "behind the filter"):
        runs = []
        for i in range(EPISODES):
            env = quadsim.gym.make_env(filtered_air(AIR[i % len(AIR)]))
            runs.append(episode(quadsim.gym.MPCSafetyFilter(env) if name != "random agent" else env, seed=i))
            env.close()
        steps = sum(run["steps"] for run in runs)
        filtered = name != "random agent"
        rows.append(
            (
                name,
                str(len(runs)),
                str(sum(run["margin"] >= 0.0 for run in runs)),
                str(sum(bool(run["lost"]) for run in runs)),
                f"{LARGEST - min(run['margin'] for run in runs):.2f}",
                f"{100.0 * sum(run['stepped in'] for run in runs) / steps:.0f} % of steps" if filtered else "-",
                f"{sum(run['correction'] for run in runs) / steps:.1f}" if filtered else "-",
            )
        )
    return rows


def imitation() -> Table:
    """How often teacher and students break what the teacher holds."""
    rows: Table = [("", "flights", "a constraint broken in", "beyond 5 deg by at most, deg", "mean RMS error, m")]
    for name, flights in compared(learn()).items():
        broken = sum(not flight.satisfied for flight in flights)
        error = np.mean([flight.metrics[f"rmse.{axis}"] for flight in flights for axis in "xyz"])
        most = max(0.0, *map(beyond, flights))
        rows.append((name, str(len(flights)), str(broken), f"{most:.2f}", f"{error:.3f}"))
    return rows


def real_time_factor(name: str, steps: int = 600, **options: Any) -> float:
    """Simulated seconds per second of processor time, `info` and a reset included."""
    env = quadsim.gym.make_env(name, **options)
    env.reset(seed=0)
    action = np.zeros(4, env.action_space.dtype)
    best = 0.0
    for _ in range(3):
        started, ended = time.process_time(), False
        env.reset(seed=0)
        for _ in range(steps):
            _, _, terminated, truncated, _ = env.step(action)
            ended = terminated or truncated
            if ended:
                env.reset()
        best = max(best, steps * env.unwrapped.scenario.control_period / (time.process_time() - started))
    env.close()
    return best


def speed(crazyflow: str | None) -> Table:
    """Real-time factors on one core; the best of three."""
    rows: Table = [("environment", "times real time, per core")]
    cases: dict[str, tuple[str, dict[str, Any]]] = {
        "`PaperConstrained`, all constraints at 1 kHz": ("paper-constrained", {}),
        "the same, thrust and body rates (inner loop of 500 Hz)": ("paper-constrained", {"action": "rates"}),
        "`MotionCapture`, sensors and Kalman filter": ("motion-capture", {}),
        "`Turbulence`, forces in each physics step": ("turbulence", {}),
    }
    rows += [(text, f"{real_time_factor(name, **options):.0f}") for text, (name, options) in cases.items()]
    if crazyflow:
        command = [crazyflow, str(HERE / "crazyflow_speed.py"), "1", "100"]
        found = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()[-1])
        for worlds, factor in found.items():
            rows.append((f"crazyflow, `ReachPosEnv`, 20 Hz, {worlds} at once on the CPU", f"{factor:.0f}"))
    return rows


def between_samples() -> tuple[Table, dict[str, Any]]:
    """How often the paper's controller is beyond its bounds between two samples that keep them."""
    env = quadsim.gym.make_env("paper-constrained")
    _, info = env.reset()
    before, ended = info["margins_sampled"], False
    count, most = dict.fromkeys(("roll", "pitch"), 0), dict.fromkeys(("roll", "pitch"), 0.0)
    worst: tuple[float, float] = (0.0, 0.0)
    while not ended:
        _, _, terminated, truncated, info = env.step(env.unwrapped.controller_action())
        for name in count:
            margin = info["margins"][name]
            if margin < 0.0 <= min(before[name], info["margins_sampled"][name]):
                count[name] += 1
                most[name] = max(most[name], -margin)
                if name == "roll":
                    worst = max(worst, (-margin, info["time"]))
        before, ended = info["margins_sampled"], terminated or truncated
    flight = env.unwrapped.flight()
    env.close()
    rows: Table = [("bound", "periods", "violated between two samples that keep it", "by at most, deg")]
    rows += [(name, str(flight.time.size), str(count[name]), f"{most[name]:.3f}") for name in count]
    return rows, {"flight": flight, "time": worst[1]}


def draw(shown: dict[str, Any]) -> Callable[[], Any]:
    """The figure: a violation that samples miss, and a random agent's tilt."""

    def figure() -> Any:
        import matplotlib.pyplot as plt

        drawing, (left, right) = plt.subplots(1, 2, figsize=(10.0, 3.6), layout="constrained")
        flight, middle = shown["flight"], shown["time"]
        t, roll = flight.plant["t"], np.degrees(flight.plant["roll"])
        near = np.abs(t - middle) < 0.3
        sign = np.sign(roll[near][np.argmax(np.abs(roll[near]))])
        left.plot(t[near], sign * roll[near], label="1 kHz: what `margins` sees")
        every = np.abs(flight.time - middle) < 0.3
        samples = sign * np.degrees(flight.state["roll"])[every]
        left.plot(flight.time[every], samples, "o", label="20 Hz: what a check of samples sees")
        left.axhline(5.0, color="tab:red", linewidth=1.0, label="bound")
        left.set(xlabel="time [s]", ylabel="roll [deg]", ylim=(4.9, 5.03), title="The paper's controller")
        left.legend(fontsize=8)
        for name, filtered in (("without filter", False), ("behind the filter", True)):
            env = quadsim.gym.make_env(filtered_air("turbulence"))
            env = quadsim.gym.MPCSafetyFilter(env) if filtered else env
            episode(env, seed=0)
            plant = env.unwrapped.flight().plant
            lean = np.degrees(np.arccos(np.cos(plant["roll"]) * np.cos(plant["pitch"])))
            right.plot(plant["t"], lean, label=name)
            env.close()
        right.axhline(5.0, color="tab:red", linewidth=1.0, label="5 deg")
        right.set(xlabel="time [s]", ylabel="tilt [deg]", ylim=(0.0, 12.0), xlim=(0.0, 15.0))
        right.set_title("A random agent in turbulence")
        right.legend(fontsize=8)
        return drawing

    return figure


def main() -> None:
    """Remake what was requested, or everything."""
    parts = ("samples", "safety", "imitation", "speed")
    parser = argparse.ArgumentParser()
    parser.add_argument("parts", nargs="*", choices=[*parts, []], default=[])
    parser.add_argument("--crazyflow")
    options = parser.parse_args()
    for part in options.parts or parts:
        match part:
            case "samples":
                table, shown = between_samples()
                with tempfile.TemporaryDirectory() as scratch:
                    write_drawings({"gym": draw(shown)}, Path(scratch))
                    copy_figure(Path(scratch) / "gym.png", "gym.png", 64)
            case "safety":
                table = safety()
            case "imitation":
                table = imitation()
            case _:
                table = speed(options.crazyflow)
        replace_in(PAGE, part, markdown(table), command=COMMAND)
        print(markdown(table))


if __name__ == "__main__":
    main()
