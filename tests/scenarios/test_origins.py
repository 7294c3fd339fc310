"""Where the rows of a problem come from: the scenario file has the very number that each of them is."""

from __future__ import annotations

import tomllib
from typing import Any

import numpy as np
import pytest

import quadsim
from quadsim.scenarios.schema.settings import get_field

FENCE = {"of": ["x", "y"], "rows": [[1.0, 1.0], [1.0, -1.0]], "lower": [-20.0, -21.0], "upper": [22.0, 23.0]}
TURNING = {"of": ["roll_rate", "speed_2"], "rows": [[1.0, 0.0], [0.0, 1.0], [1.0, 0.1]], "upper": [90.0, 240.0, 150.0]}
POLYTOPES: list[dict[str, Any]] = [{"name": "fence", **FENCE}, {"name": "turning", **TURNING}]


@pytest.mark.parametrize(
    ("name", "changes"),
    [("paper-constrained", {}), ("robust", {"controller.tightening": None, "controller.heading": False})],
)
def test_the_file_has_each_bound_where_its_row_says(name: str, changes: dict[str, Any]) -> None:
    scenario = quadsim.load(name).replace({**changes, "controller.polytopes": POLYTOPES})
    file = tomllib.loads(scenario.to_toml())
    seen = set()
    for constraint in quadsim.problem(scenario).every_constraint:
        for row in range(constraint.lower.shape[-1]):
            origin = constraint.origin(row)
            for upper in (False, True):
                bound = (constraint.upper if upper else constraint.lower)[row]
                if np.isfinite(bound):
                    field, entry = origin.place(upper=upper)
                    assert origin.factor * bound == pytest.approx(get_field(file, field)[entry], rel=1e-12)
                    seen.add((field, entry))
    pairs = [f"output_bounds.{state}" for state in file["controller"]["output_bounds"]]
    pairs += ["input_bounds.speed", "input_bounds.slew"]
    stated = {(f"controller.{pair}", side) for pair in pairs for side in (0, 1)}
    stated |= {
        (f"controller.polytopes.{polytope['name']}.{side}", row)
        for polytope in POLYTOPES
        for side in ("lower", "upper")
        for row in range(len(polytope.get(side, ())))
    }
    assert seen == stated


def test_units_and_names_are_those_of_the_file() -> None:
    scenario = quadsim.load("paper-constrained").replace({"controller.polytopes": POLYTOPES})
    outputs, slews, inputs, fence, turning = quadsim.problem(scenario).every_constraint
    assert [(outputs.origin(i).name, outputs.origin(i).unit) for i in range(2)] == [("roll", "deg"), ("pitch", "deg")]
    assert [(slews.origin(3).name, slews.origin(3).rotor), (inputs.origin(0).name, inputs.origin(0).rotor)] == [
        ("slew", 4),
        ("speed", 1),
    ]
    assert [(fence.origin(i).name, fence.origin(i).unit) for i in range(2)] == [("fence_1", "m"), ("fence_2", "m")]
    assert [turning.origin(i).unit for i in range(3)] == ["deg/s", "rad/s", "-"]
