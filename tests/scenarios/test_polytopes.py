"""`[[controller.polytopes]]` and `terminal`: what is refused, the rows in SI units, and the audit by the same rows."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from quadsim.flight.audit import SUM, audit
from quadsim.flight.rundir import limit_from_json, limit_to_json
from quadsim.mpc.problem.ocp import Problem
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.loading import load_scenario, parse_scenario
from quadsim.state import INDEX
from tests.support import scenario_table, small_log

MIXED: dict[str, Any] = {
    "name": "mixed",
    "of": ["pitch", "x", "speed_2"],
    "rows": [[1.0, 2.0, 0.0], [0.0, 0.0, 1.0]],
    "lower": [-3.0, 10.0],
    "upper": [4.0, 240.0],
}


def table(**changes: Any) -> dict[str, Any]:
    small = scenario_table()
    small["controller"]["polytopes"] = [{**MIXED, **changes}]
    return small


def problem_of(small: dict[str, Any]) -> Problem:
    scenario = parse_scenario(small)
    return Assembly(scenario).problem()


def test_rows_are_in_the_units_of_the_file() -> None:
    (constraint,) = problem_of(table()).constraints
    assert constraint.C is not None
    assert constraint.D is not None
    state = np.zeros(12)
    speeds = np.array([1.0, 20.0, 3.0, 4.0])
    state[INDEX["pitch"]] = math.radians(0.5)
    state[INDEX["x"]] = 3.0
    np.testing.assert_allclose(constraint.C @ state + constraint.D @ speeds, [0.5 + 6.0, 20.0])
    np.testing.assert_array_equal(constraint.upper, [4.0, 240.0])
    assert constraint.penalty is None


def test_the_audit_sees_the_same_rows_at_the_physics_rate() -> None:
    scenario = parse_scenario(table())
    log = small_log()
    limits = [limit for limit in Assembly(scenario).limits if limit.signal == SUM]
    assert [limit.name for limit in limits] == ["mixed_1", "mixed_2"]
    assert [limit.unit for limit in limits] == ["-", "rad/s"]
    (constraint,) = problem_of(table()).constraints
    assert constraint.C is not None
    assert constraint.D is not None
    values = log.plant.state @ constraint.C.T + log.plant.speeds @ constraint.D.T
    for row, finding in enumerate(audit(log, tuple(limits))):
        margin = np.minimum(values[:, row] - constraint.lower[row], constraint.upper[row] - values[:, row])
        assert finding.worst_margin == pytest.approx(margin.min(), abs=1e-9)
        assert finding.worst_time == log.plant.t[np.argmax(margin <= margin.min() + finding.limit.tie)]
        assert limit_from_json(limit_to_json(finding)) == finding.limit


def test_the_robust_controller_takes_them_too() -> None:
    settings = [
        "controller.heading=false",
        'controller.terminal="lqr"',
        'controller.polytopes=[{name="fence", of=["x"], rows=[[1.0]], upper=[3.0], soft={}}]',
    ]
    scenario = load_scenario("robust", settings)
    assert Assembly(scenario).controller().name == "robust"
    assert "fence" in [limit.name for limit in Assembly(scenario).limits]


def test_a_terminal_weight_needs_a_riccati_equation_with_a_solution() -> None:
    small = scenario_table()
    small["controller"] |= {"terminal": "lqr", "output_weights": {"z": 1.0}}
    with pytest.raises(Exception, match="terminal"):
        problem_of(small)
