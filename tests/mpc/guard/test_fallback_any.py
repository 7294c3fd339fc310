"""The fallback contract under any answer and any state: no command outside the bounds or not finite ever leaves."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scripted_controller import Scripted, bounds, guard, model

from quadsim.controller import Command, Phase, StepInputs
from quadsim.errors import CommandError
from quadsim.mpc.guard.contract import FallbackSettings
from quadsim.state import Array

NUMBERS = st.sampled_from([math.nan, math.inf, -math.inf, 0.0, -1e300, 1e300, 1e5, 190.0, 250.0, 251.0])
ANSWERS = st.one_of(
    st.just({}),
    st.sampled_from([RuntimeError("no"), np.linalg.LinAlgError("no"), CommandError("no", time=0.0)]),
    st.builds(lambda value: {"speeds": np.full(4, value)}, NUMBERS),
    st.builds(lambda value: {"plan": np.full((5, 4), value)}, NUMBERS),
    st.builds(lambda value: {"plan": np.vstack([model().u_bar, np.full((4, 4), value)])}, NUMBERS),
    st.builds(lambda size: {"speeds": np.full(size, 192.0)}, st.integers(0, 6)),
    st.builds(lambda size: {"plan": np.full((5, size), 192.0)}, st.integers(0, 6)),
    st.sampled_from(["numerics", "unconstrained", "landed"]).map(lambda status: {"status": status}),
)
CHANNEL = st.one_of(st.just(0.0), st.floats(-1.0, 1.0), st.floats(), st.just(math.nan))
STATES = st.one_of(
    st.lists(CHANNEL, min_size=12, max_size=12).map(np.array),
    st.lists(st.floats(-0.3, 0.3), min_size=12, max_size=12).map(np.array),
    st.lists(st.floats(-1e3, 1e3), min_size=12, max_size=12).map(np.array),
    st.just(np.full(12, math.nan)),
    st.just(np.ones(12)),  # frozen, where it comes again
    st.integers(0, 13).map(np.zeros),
)
ACTING = st.one_of(st.none(), st.lists(NUMBERS, min_size=4, max_size=4).map(np.array))
STEPS = st.tuples(ANSWERS, STATES, ACTING, st.sampled_from([*Phase]), CHANNEL)


@given(steps=st.lists(STEPS, min_size=1, max_size=8), hover=st.sampled_from([0.1, 5.0]))
def test_no_invalid_command_leaves(steps: list[Any], hover: float) -> None:
    class Adversary(Scripted):
        answer: Any = None
        foreseen: float = 0.0

        def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
            assert np.isfinite(state).all()
            assert now.acting is not None
            assert np.isfinite(now.acting).all()
            self.script = {len(self.calls): self.answer}
            return super().step(now, state, reference)

        def predict(self, states: Array, plans: Array) -> Array:
            return np.full((1, 5, 12), self.foreseen)  # often 0, and then not far from the state

    inner = Adversary(horizon=5)
    guarded = guard(inner, settings=FallbackSettings(hover=hover))
    before = model().u_bar
    for inner.answer, state, acting, phase, desired in steps:
        inner.foreseen = desired
        command = guarded.step(StepInputs(phase=phase, acting=acting), state, np.full((5, 4), desired))
        usable = acting is not None and np.isfinite(acting).all() and np.abs(acting).max() <= 1e5
        lower, upper = bounds().reach(acting if usable else before)
        assert command.speeds.shape == (4,)
        assert command.plan.shape == (5, 4)
        assert (lower <= command.speeds).all()  # as NaN is not
        assert (command.speeds <= upper).all()
        assert ((bounds().u_min <= command.plan) & (command.plan <= bounds().u_max)).all()
        steps = np.diff(command.plan, axis=0)
        assert ((bounds().delta_min - 1e-9 <= steps) & (steps <= bounds().delta_max + 1e-9)).all()
        assert command.fallback in {0, 1, 2, 3}
        before = command.speeds
