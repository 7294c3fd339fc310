"""examples/ppo.py but for stable-baselines3: its task, its comparison, and what it writes."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from quadsim.report.to_matplotlib import draw

ROOT = Path(__file__).resolve().parents[3]
sys.path.insert(0, str(ROOT / "examples"))

import ppo  # noqa: E402

pytestmark = pytest.mark.slow("gym")


def brakes(env: ppo.Env, observation: ppo.Array) -> ppo.Array:
    """PD by hand: from place and velocity to tilt, from tilt to body rates, as shares of 6, 6 and 2 rad/s."""
    place, (vx, vy, vz), (roll, pitch, _) = observation[:3], observation[[5, 7, 9]], observation[[10, 12, 14]]
    x, y, z = (2.0 * place - 2.0 * np.array([vx, vy, vz])) / 9.81
    rates = 6.0 * np.array([-y - roll, x - pitch]) / 6.0
    return np.clip([z, *rates, observation[3]], -1.0, 1.0).astype(np.float32)


def test_who_brakes_holds_the_place_and_who_does_nothing_is_lost() -> None:
    done, braked, again = (
        ppo.evaluate(name, policy, ppo.make_env(), episodes=3)
        for name, policy in (("nothing", ppo.nothing), ("braked", brakes), ("braked", brakes))
    )
    assert braked == again
    assert braked.lost == 0
    assert braked.least_return > 160.0
    assert braked.error < 0.5
    assert done.lost == 3
    assert done.mean_return < 60.0
    assert done.error > 1.0


def test_the_mpc_flies_the_same_episodes() -> None:
    score = ppo.evaluate("MPC", ppo.mpc, ppo.make_env("speeds"), episodes=2)
    assert (score.lost, score.episodes) == (0, 2)
    assert 185.0 < score.least_return <= score.mean_return < 200.0
    rates, speeds = ppo.make_env(), ppo.make_env("speeds")
    for seed in (ppo.FIRST_SEED, ppo.FIRST_SEED + 1):
        np.testing.assert_array_equal(rates.reset(seed=seed)[0], speeds.reset(seed=seed)[0])


def test_a_learned_policy_sees_what_is_normalised_and_does_not_explore() -> None:
    class Model:
        def predict(self, observation: Any, *, deterministic: bool) -> tuple[Any, None]:
            return (observation, None) if deterministic else (None, None)

    class Normalisation:
        def normalize_obs(self, observation: Any) -> Any:
            return observation / 2.0

    policy = ppo.learned(Model(), Normalisation())
    np.testing.assert_array_equal(policy(ppo.make_env(), np.array([2.0, 4.0])), [1.0, 2.0])


def test_the_curve_of_the_page_is_one_that_the_example_writes(tmp_path: Path) -> None:
    """And it learned: far more than doing nothing, in training and in episodes that it has not seen."""
    data = ROOT / "docs" / "data"
    curve, scores = ppo.read_csv(data / "ppo.csv", ppo.Rollout), ppo.read_csv(data / "ppo-evaluation.csv", ppo.Score)
    for name, rows in (("ppo.csv", curve), ("ppo-evaluation.csv", scores)):
        ppo.write_csv(tmp_path / name, rows)
        assert ppo.read_csv(tmp_path / name, type(rows[0])) == rows
        assert header(tmp_path / name) == header(data / name)
    means = {score.policy: score.mean_return for score in scores}
    assert {*means} == {"PPO", "MPC", "nothing"}
    assert curve[0].mean_return < 0.3 * curve[-1].mean_return
    assert means["nothing"] < 0.3 * means["PPO"] < means["MPC"]
    (axes,) = draw(ppo.curve_figure(curve, scores)).axes
    learning, *others = axes.get_lines()
    np.testing.assert_array_equal(learning.get_xdata(), [rollout.steps for rollout in curve])
    np.testing.assert_array_equal(learning.get_ydata(), [rollout.mean_return for rollout in curve])
    assert {line.get_ydata()[0] for line in others} == {means["MPC"], means["nothing"]}


def header(path: Path) -> str:
    return path.read_text(encoding="utf-8").splitlines()[0]
