"""Zoomable plots for a page that works offline."""

from quadsim.plots.cost import cost_plots
from quadsim.plots.flights import comparison_plots, thin
from quadsim.plots.panels import Plot, plotly_script

__all__ = ["Plot", "comparison_plots", "cost_plots", "plotly_script", "thin"]
