"""What a problem may be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support import paper_problem

from mpc.ocp import Objective
from quadsim.errors import ParameterError


@pytest.mark.parametrize(
    "matrix",
    [np.diag([1.0, 0.0]), np.diag([1.0, -1.0]), np.array([[1.0, 2.0], [2.0, 1.0]]), np.array([[1.0, 0.5], [0.0, 1.0]]),
     np.diag([1.0, np.nan])],
)  # fmt: skip
@pytest.mark.parametrize("weight", ["Q_y", "Q_u"])
def test_weights_must_be_positive_definite(matrix: np.ndarray, weight: str) -> None:
    weights = {"Q_y": np.eye(2), "Q_u": np.eye(2), weight: matrix}
    with pytest.raises(ParameterError, match=rf"controller\.{weight} must be symmetric and positive definite"):
        Objective(C_r=np.eye(2), **weights)


@pytest.mark.parametrize("horizon", [0, -3, 2.5])
def test_horizon_must_be_a_whole_positive_number(horizon: float) -> None:
    with pytest.raises(ParameterError, match=r"controller\.horizon must be a whole number >= 1"):
        replace(paper_problem(), horizon=horizon)


def test_regulated_outputs_are_n_r_by_n() -> None:
    """Erratum after Eq. (4), which prints n_r by n_r."""
    assert paper_problem().objective.C_r.shape == (4, 12)
    with pytest.raises(ParameterError, match=r"controller\.C_r must be of shape"):
        Objective(C_r=np.eye(3), Q_y=np.eye(4), Q_u=np.eye(4))
    with pytest.raises(ParameterError, match=r"controller\.C_r must be of shape \(4, 12\)"):
        replace(paper_problem(), objective=Objective(C_r=np.eye(4), Q_y=np.eye(4), Q_u=np.eye(4)))


def test_desired_outputs_are_the_reference_and_zero_elsewhere() -> None:
    reference = np.array([[1.0, 2.0, 3.0, 0.5]])
    np.testing.assert_array_equal(paper_problem().objective.desired(reference), reference)
    full = paper_problem("paper-unconstrained").objective.desired(reference)
    np.testing.assert_array_equal(full, [[1, 0, 2, 0, 3, 0, 0, 0, 0, 0, 0.5, 0]])
