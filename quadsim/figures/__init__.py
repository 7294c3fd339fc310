"""Figures on paper, as PNG and SVG.

The same numbers give the same bytes: no date, no random identifiers, no global state of matplotlib.
"""

from quadsim.figures.bench import write_solver_figure
from quadsim.figures.cost import write_cost_figures
from quadsim.figures.flights import comparison_figure, write_figures
from quadsim.figures.ladder import write_ladder_figure

__all__ = ["comparison_figure", "write_cost_figures", "write_figures", "write_ladder_figure", "write_solver_figure"]
