"""Campaigns without a flight: tables in the columns of `quadsim.features.campaign.rows`, filled from a known law."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from quadsim.features.campaign.rows import make_schema, make_table, split_times
from quadsim.flight.audit import Limit
from quadsim.rollout.many import Row

LIMITS = (
    Limit(name="roll", signal="roll", lower=-5.0, upper=5.0, tolerance=0.05),
    Limit(name="slew", signal="slew", lower=-6.0, upper=6.0, required=False),
)
DRAWS = {
    **dict.fromkeys(("mass", "inertia", "noise", "yaw"), (pa.float64(), "-")),
    "lag": (pa.float64(), "s"),
    "wind": (pa.float64(), "m/s"),
    "horizon": (pa.int64(), "-"),
    "solver": (pa.string(), "-"),
    "payload": (pa.bool_(), "-"),
}

MakeCampaign = Callable[..., pa.Table]


def campaign_table(flights: int, *, seed: int = 0, severity: float = 1.0, help_by: float = 0.0) -> pa.Table:
    """Flights whose margin falls with mass and wind, at both ends of yaw alike, and not with the rest.

    Args:
        flights: how many.
        seed: of everything drawn, hence what is shared between campaigns to be paired.
        severity: 1 for a few failures in a hundred, 0 for none, 100 for nothing else.
        help_by: how much more margin a better controller leaves.
    """
    schema = make_schema(DRAWS, LIMITS)
    rng = np.random.default_rng(seed)
    rows = [_row(flight, np.random.default_rng([seed, flight]), severity, help_by) for flight in range(flights)]
    rng.shuffle(rows)
    return split_times(make_table(rows, schema))[0]


@pytest.fixture(scope="session")
def make_campaign() -> MakeCampaign:
    return campaign_table


@pytest.fixture(scope="session")
def thousand() -> pa.Table:
    return campaign_table(1000)


def _row(flight: int, rng: np.random.Generator, severity: float, help_by: float) -> Row:
    mass, inertia, lag, wind, noise, yaw = rng.uniform([0.8, 0.8, 0.0, 0.0, 0.0, -1.0], [1.2, 1.2, 0.03, 6.0, 0.1, 1.0])
    draws = {
        **{"mass": mass, "inertia": inertia, "lag": lag, "wind": wind, "noise": noise, "yaw": yaw},
        **{"horizon": int(rng.integers(20, 60)), "solver": str(rng.choice(["piqp", "daqp", "gain"]))},
        "payload": bool(rng.random() < 0.3),
    }
    harm = 1.0 * (mass - 0.8) + 0.09 * wind + 0.2 * yaw**2 + 0.1 * rng.normal() - help_by
    margin = 0.95 - severity * max(harm, -0.02) if severity else 0.9 - 0.1 * rng.random()
    row: Row = {
        **{"flight": flight, "seed": 10_000 + flight},
        **{f"draw.{name}": value for name, value in draws.items()},
    }
    if severity and rng.random() < 0.002:
        failed: Row = {"status": "error", "verdict": "error", "reason": "ValueError: <b>no</b> step & none"}
        return row | failed | {"failed": True, "violated": True, "crashed": False}
    lost = margin < -0.22
    verdict = "lost" if lost else "violated" if margin < 0.0 else "satisfied"
    errors: dict[str, Any] = {
        f"rmse.{name}": float(0.02 + 0.05 * rng.gamma(2.0) * (1 + lost * 40) * (1.0 - help_by)) for name in "xyz"
    }
    roll = 5.0 * margin - 0.05
    return row | {
        **{"status": "aborted" if lost else "completed", "verdict": verdict},
        "reason": "at t = 12.400 s: the plant's state is not finite" if lost else None,
        **{"failed": verdict != "satisfied", "violated": verdict != "satisfied", "crashed": lost and flight % 2 == 0},
        "duration": 12.4 if lost else 60.0,
        **errors,
        "rmse.yaw": float(abs(0.01 * rng.normal())),
        **{f"max_error.{name}": 3.0 * errors[f"rmse.{name}"] for name in "xyz"},
        **{"peak_tilt": 5.0 - roll, "total_variation": float(rng.normal(900.0, 40.0))},
        **{"fallback_periods": int(rng.poisson(2.0 * (margin < 0.3))), "iterations.max": 12, "slack_max": 0.0},
        **{"margin.roll": roll, "time_violated.roll": max(0.0, -roll), "satisfied.roll": margin >= 0.0},
        **{"margin.slew": float(rng.normal(2.0, 0.5)), "time_violated.slew": 0.0, "satisfied.slew": True},
        "worst_margin": None if lost and flight % 3 == 0 else margin,
        "worst_constraint": None if lost and flight % 3 == 0 else "roll",
    }
