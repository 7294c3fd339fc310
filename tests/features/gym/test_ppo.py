"""examples/ppo.py: its mathematics, that it learns, and that what it learned flies as a controller."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import quadsim
import quadsim.gym
from quadsim.features.campaign.plan import load_plan
from quadsim.features.gym.tasks import tracking_reward
from quadsim.report.to_matplotlib import draw
from quadsim.state import INDEX

ROOT = Path(__file__).resolve().parents[3]
sys.path.insert(0, str(ROOT / "examples"))

import ppo  # noqa: E402
import ppo_policy  # noqa: E402

pytestmark = pytest.mark.slow("gym")

FLIGHT = ROOT / "examples" / "ppo_flight.toml"
SMALL = ppo.Settings(environments=8, length=32, units=(8,), minibatch=64)


def small_envs(settings: ppo.Settings = SMALL, **changes: Any) -> Any:
    """The task from one start, which needs no draws."""
    arguments = {**quadsim.gym.TASKS[ppo_policy.TASK], "vary": None, **changes}
    return quadsim.gym.make_vec(**arguments, num_envs=settings.environments, autoreset_mode="SameStep")


# --- the task ------------------------------------------------------------------------------------------------------


def test_the_task_has_an_id_and_starts_anew_at_each_reset() -> None:
    env = gymnasium.make(ppo_policy.TASK)
    first, _ = env.reset(seed=1)
    second, _ = env.reset()
    again, _ = env.reset(seed=1)
    assert first.shape == (4 * 10 + 12,)
    assert not np.array_equal(first, second)
    np.testing.assert_array_equal(first, again)
    names = [entry.name for entry in env.unwrapped.observations.layout]
    assert [names[i] for i in ppo.PLACES] == ["x", "y", "z"]
    assert names[:3] == ["x[1] ahead", "y[1] ahead", "z[1] ahead"]


def test_the_reward_of_tracking_is_largest_on_the_reference_and_never_negative() -> None:
    states = np.zeros((5, 12))
    states[1, INDEX["x"]] = 0.1
    states[2, INDEX["yaw"]] = -0.2
    states[3, INDEX["roll"]] = np.radians(-14.5)
    states[4] = 100.0
    rewards = tracking_reward(states, np.zeros((5, 4)), np.zeros((5, 4)))
    assert rewards[:4] == pytest.approx([1.0, np.exp(-0.3), np.exp(-0.2), np.exp(-1.0)])
    assert rewards[4] >= 0.0


# --- the mathematics -----------------------------------------------------------------------------------------------


def test_the_gradient_of_a_network_is_that_of_finite_differences() -> None:
    rng = np.random.default_rng(0)
    layers = [part.astype(np.float64) for part in ppo.make_layers(rng, (5, 4, 3, 2), 1.0)]
    inputs = rng.standard_normal((7, 5))
    slope = rng.standard_normal((7, 2))
    gradient = ppo.backward(layers, ppo.forward(layers, inputs), slope)
    step = 1e-6
    for part, expected in zip(layers, gradient, strict=True):
        for place in np.ndindex(part.shape):
            ends = []
            for change in (step, -step):
                part[place] += change
                ends.append(float(np.sum(slope * ppo.forward(layers, inputs)[-1])))
                part[place] -= change
            assert (ends[0] - ends[1]) / (2.0 * step) == pytest.approx(expected[place], abs=1e-7)


def test_running_moments_are_those_of_everything_seen() -> None:
    rng = np.random.default_rng(0)
    parts = [rng.normal(3.0, 2.0, (count, 2)) for count in (5, 1, 40)]
    moments = ppo.Moments(2)
    for part in parts:
        moments.include(part)
    everything = np.concatenate(parts)
    np.testing.assert_allclose(moments.mean, everything.mean(axis=0), rtol=1e-4)
    np.testing.assert_allclose(moments.variance, everything.var(axis=0), rtol=1e-3)


def test_advantages_are_discounted_sums_that_end_with_the_episode() -> None:
    learner = ppo.Learner(small_envs(), SMALL)
    rng = np.random.default_rng(0)
    length = 6
    count = 2
    rollout = ppo.Rollout()
    rollout.rewards = list(rng.random((length, count)))
    rollout.values = list(rng.random((length + 1, count)))
    rollout.ended = [np.array([False, t == 3]) for t in range(length)]
    rollout.values_at_end = [np.where(ended, 0.7, 0.0) for ended in rollout.ended]
    discount = SMALL.discount
    trace = SMALL.trace
    expected = np.zeros((length, count))
    for i in range(count):
        for t in range(length):
            weight = 1.0
            for later in range(t, length):
                ended = rollout.ended[later][i]
                after = rollout.values_at_end[later][i] if ended else rollout.values[later + 1][i]
                reward = (1.0 - discount) * rollout.rewards[later][i]
                expected[t, i] += weight * (reward + discount * after - rollout.values[later][i])
                weight *= discount * trace
                if ended:
                    break
    np.testing.assert_allclose(learner.advantages(rollout), expected, rtol=1e-12)


def test_an_update_makes_better_actions_likelier_but_not_by_more_than_the_clip() -> None:
    learner = ppo.Learner(small_envs(), SMALL)
    rng = np.random.default_rng(0)
    inputs = rng.standard_normal((64, learner.observed.shape[1])).astype(np.float32)
    means = ppo.forward(learner.actor, inputs)[-1]
    noise = rng.standard_normal(means.shape).astype(np.float32)
    actions = means + SMALL.deviation * noise
    before = np.sum(-0.5 * noise**2 - learner.log_deviation, axis=1)
    for _ in range(200):
        learner.improve_actor(inputs, actions, before, actions[:, 0], 1e-3)
    moved = ppo.forward(learner.actor, inputs)[-1]
    assert (moved - means)[:, 0].mean() > 0.02
    log_deviation = learner.log_deviation
    after = np.sum(-0.5 * ((actions - moved) / np.exp(log_deviation)) ** 2 - log_deviation, axis=1)
    ratio = np.exp(after - before)
    assert ratio[actions[:, 0] > 0.2].mean() > 1.05
    assert np.median(ratio) < 1.0 + 2.0 * SMALL.clip


# --- learning ------------------------------------------------------------------------------------------------------


@pytest.mark.representative("gym")
def test_a_few_updates_raise_the_reward_and_repeat_to_the_bit() -> None:
    """In episodes of 1.5 s, in which staying up and in place is all there is to learn."""
    settings = ppo.Settings(environments=32, length=30, minibatch=120, units=(16, 16), epochs=10, learning_rate=2e-3)
    curves = []
    for updates in (25, 2):
        learner = ppo.Learner(small_envs(settings, max_episode_steps=settings.length), settings)
        learner.learn(updates, report=False)
        curves.append(learner.curve)
    longer, shorter = curves
    assert longer[0] == shorter[0]
    rewards = [point.reward for point in longer]
    assert np.mean(rewards[-3:]) > 1.5 * np.mean(rewards[:3])


def test_the_policy_that_ships_flies_unseen_starts_within_ten_centimetres() -> None:
    plan = load_plan(str(ppo.CAMPAIGN), seed=ppo.EVALUATION_SEED)
    squares = []
    for flight in range(5):
        flown = quadsim.fly(plan.of(flight), progress=False)
        assert flown.reason is None
        squares.append(flown.metrics["position_error.rms"] ** 2)
    assert np.sqrt(np.mean(squares)) < ppo.CLAIM


def test_the_flight_of_a_policy_is_its_episode_to_the_bit() -> None:
    flight = quadsim.fly(FLIGHT, progress=False)
    policy = ppo_policy.Policy.load(FLIGHT.with_name("ppo_policy.json"))
    env = quadsim.gym.make_env(**{**quadsim.gym.TASKS[ppo_policy.TASK], "vary": None})
    observation, _ = env.reset(seed=0)
    ended = False
    while not ended:
        observation, _, terminated, truncated, _ = env.step(policy.action(observation))
        ended = terminated or truncated
    episode = env.unwrapped.flight()
    np.testing.assert_array_equal(flight.log.plant.state, episode.log.plant.state)
    assert flight.controller == "PPO"
    assert {finding.limit.name for finding in flight.audit} >= {"roll", "pitch", "speed", "hold_x", "hold_y", "hold_z"}


def test_a_policy_is_read_as_it_was_written(tmp_path: Path) -> None:
    learner = ppo.Learner(small_envs(), SMALL)
    policy = learner.policy()
    policy.save(tmp_path / "policy.json")
    read = ppo_policy.Policy.load(tmp_path / "policy.json")
    observation = learner.observed[0]
    np.testing.assert_allclose(read.action(observation), policy.action(observation), atol=1e-5)
    read.save(tmp_path / "again.json")
    assert (tmp_path / "again.json").read_bytes() == (tmp_path / "policy.json").read_bytes()


# --- what the page shows -------------------------------------------------------------------------------------------


def test_the_curve_of_the_page_is_one_that_the_example_writes(tmp_path: Path) -> None:
    file = ROOT / "docs" / "data" / "ppo.csv"
    curve = ppo.read_curve(file)
    ppo.write_csv(tmp_path / "ppo.csv", curve)
    assert ppo.read_curve(tmp_path / "ppo.csv") == curve
    assert (tmp_path / "ppo.csv").read_text().splitlines()[0] == file.read_text(encoding="utf-8").splitlines()[0]
    assert curve[-1].error < ppo.CLAIM < curve[0].error
    (axes,) = draw(ppo.curve_figure(curve)).axes
    learning = axes.get_lines()[0]
    np.testing.assert_array_equal(learning.get_xdata(), [point.steps for point in curve])
    np.testing.assert_allclose(learning.get_ydata(), [100.0 * point.error for point in curve])
