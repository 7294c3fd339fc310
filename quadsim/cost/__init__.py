"""What do constraints cost?  The answer as plain numbers, and as the tables and sentences made from them.

A study is measured by `scenarios.cost`, which can fly; here it is held, and told.
"""

from quadsim.cost.sentences import cost_sentences
from quadsim.cost.study import MEASURES, Contender, CostStudy, Measure, Outcome, Sweep, SweepPoint, Variation
from quadsim.cost.tables import cost_markdown, cost_tables

__all__ = [
    "MEASURES",
    "Contender",
    "CostStudy",
    "Measure",
    "Outcome",
    "Sweep",
    "SweepPoint",
    "Variation",
    "cost_markdown",
    "cost_sentences",
    "cost_tables",
]
