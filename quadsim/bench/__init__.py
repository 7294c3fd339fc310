"""What `quadsim bench` measures, as data, and the tables made from it."""

from quadsim.bench.campaign import CampaignProfile, CampaignRun, campaign_tables
from quadsim.bench.ladder import Ladder, LadderFlight
from quadsim.bench.ladder_tables import ladder_legend, ladder_tables
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
    "CampaignProfile",
    "CampaignRun",
    "Contender",
    "FlightProfile",
    "Growth",
    "Ladder",
    "LadderFlight",
    "RenderProfile",
    "SolverBench",
    "StageLength",
    "Target",
    "campaign_tables",
    "flight_tables",
    "flight_targets",
    "ladder_legend",
    "ladder_tables",
    "render_tables",
    "render_targets",
    "solver_tables",
    "solver_targets",
]
