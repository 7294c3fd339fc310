"""Which candidate is better: Pareto fronts against their definition, and what is infeasible behind all that is not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scenarios.tuning.ranking import Score, distances, fronts, ranked

POINTS = st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5)), min_size=1, max_size=12)


def make(candidate: int, *values: float, excess: float = -0.1) -> Score:
    return Score(candidate=candidate, flights=4, count=0, completed=4, values=values, excess=excess)


@given(POINTS)
def test_a_point_of_a_front_is_beaten_from_the_front_before_and_not_from_its_own(points: list[tuple[int, int]]) -> None:
    values = np.array(points, float)
    found = fronts(values)

    def beats(i: int, j: int) -> bool:
        return bool((values[i] <= values[j]).all() and (values[i] < values[j]).any())

    count = range(len(points))
    for j in count:
        assert not any(beats(i, j) for i in count if found[i] >= found[j])
        assert found[j] == 0 or any(beats(i, j) for i in count if found[i] == found[j] - 1)


def test_distances_are_shares_of_the_ranges() -> None:
    found = distances(np.array([[0.0, 10.0], [1.0, 0.0], [0.5, 5.0]]))
    assert found == pytest.approx([1.0, 1.0, np.sqrt(0.5)])
    assert distances(np.array([[2.0], [2.0]])).tolist() == [0.0, 0.0]
    assert distances(np.empty((0, 2))).size == 0


def test_feasible_ones_come_first_then_those_that_fail_less() -> None:
    scores = [make(0, 5.0, excess=0.2), make(1, 9.0), make(2, 1.0, excess=0.1), make(3, 4.0), make(4, 0.5, excess=0.1)]
    assert [each.candidate for each in ranked(scores)] == [3, 1, 4, 2, 0]
    assert ranked([make(0, 1.0, excess=1.0)])[0].candidate == 0


def test_of_two_objectives_the_first_front_comes_first() -> None:
    scores = [make(0, 3.0, 3.0), make(1, 0.0, 4.0), make(2, 4.0, 0.0), make(3, 1.0, 1.0), make(4, 4.0, 4.0)]
    assert [each.candidate for each in ranked(scores)] == [3, 1, 2, 0, 4]
