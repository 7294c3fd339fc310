"""What `quadsim bench` measures, as data, and the tables made from it."""

from quadsim.bench.results import (
    Contender,
    FlightProfile,
    Growth,
    RenderProfile,
    SolverBench,
    StageLength,
    Target,
)
from quadsim.bench.tables import flight_tables, render_tables, solver_tables
from quadsim.bench.targets import flight_targets, render_targets, solver_targets

__all__ = [
    "Contender",
    "FlightProfile",
    "Growth",
    "RenderProfile",
    "SolverBench",
    "StageLength",
    "Target",
    "flight_tables",
    "flight_targets",
    "render_tables",
    "render_targets",
    "solver_tables",
    "solver_targets",
]
