"""Tunings without flights: rows that a formula of the scenario makes, so that the best values are known."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomlkit

from scenarios.campaign.plan import Plan
from scenarios.many import Row
from scenarios.schema.scenario import Scenario
from scenarios.tuning.tuning import TuningResult, fly_tuning
from scenarios.tuning.tuning_plan import TuningPlan

BEST_SPEED, BEST_Z = 0.05, 300.0  # where the formula is smallest
TUNING: dict[str, Any] = {
    "name": "little",
    "description": "a <b>bowl</b>",
    "trials": 24,
    "batch": 6,
    "flights": [2, 4, 8],
    "require": "P(violation) < 0.2 @ 50%",
    "fresh": {"flights": 20, "seed": 1},
    "objectives": [{"name": "error", "expression": "rmse.x", "unit": "m"}],
    "search": [
        {
            "name": "speed",
            "fields": ["controller.input_weights.speed"],
            **{"distribution": "log_uniform", "low": 1e-4, "high": 1.0},
        },
        {"name": "z", "fields": ["controller.output_weights.z"], "distribution": "uniform", "low": 10.0, "high": 900.0},
    ],
    "campaign": {
        "scenario": "hover",
        "set": {"duration": 0.5, "constraints": [], "controller": {"horizon": 4}},
        "vary": [
            {"name": "mass", "fields": ["effects.load.mass_factor"], "distribution": "uniform", "low": 0.9, "high": 1.1}
        ],
    },
}


def error_of(scenario: Scenario) -> float:
    """How bad a scenario is: a bowl around the best values, and the luck of its draw, which all candidates share."""
    controller: Any = scenario.controller
    bowl = math.log10(controller.input_weights.speed / BEST_SPEED) ** 2
    bowl += ((controller.output_weights["z"] - BEST_Z) / 300.0) ** 2
    return 1.0 + bowl + 5.0 * float(np.random.default_rng(scenario.seed).random())


@dataclass
class Formula:
    """Flies nothing: `violated` decides for which scenarios a constraint does not hold.

    In order or backwards, and stopped by an exception after so many flights.
    """

    violated: Callable[[Scenario], bool] = lambda scenario: False
    backwards: bool = False
    stops_after: int | None = None
    stopped_by: Callable[[], BaseException] = KeyboardInterrupt
    flown: list[int] = field(default_factory=list)

    def fly(self, plan: Plan, flights: Sequence[int]) -> Generator[Row, None, None]:
        for flight in reversed(flights) if self.backwards else flights:
            if len(self.flown) == self.stops_after:
                raise self.stopped_by()
            self.flown.append(flight)
            scenario = plan.of(flight)
            violated = self.violated(scenario)
            row = plan.failed(flight, "", "violated" if violated else "satisfied")
            yield {**row, "status": "completed", "violated": violated, "failed": violated, "rmse.x": error_of(scenario)}


def tune_by(formula: Formula, plan: TuningPlan, directory: Path, **options: Any) -> TuningResult:
    """A tuning whose rows come from a formula."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Plan, "fly_all", lambda plan, flights, **_: formula.fly(plan, flights))
        return fly_tuning(plan, directory, **options)


def write_tuning(directory: Path, **changes: Any) -> Path:
    """A tuning file, with some of its fields replaced."""
    path = directory / "little.toml"
    path.write_text(tomlkit.dumps({**TUNING, **changes}), encoding="utf-8")
    return path
