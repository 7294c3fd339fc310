"""A bench of QP solvers -> its figure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from quadsim.report.figures.canvas import new_figure
from quadsim.report.palette import BOUND, LINES
from scenarios.bench.bench_results import CandidateResult, SolverBench
from scenarios.bench.bench_tables import PAPER_SOLVER

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_DASHES: Final = ("-", "--", ":")  # candidates beyond the colours there are take them again, with another line


def draw_solvers(bench: SolverBench) -> Figure:
    """The step times of all candidates, and their growth."""
    figure = new_figure(f"{bench.scenario}: time of a whole controller step", 9.6, 4.6)
    if not bench.growth:
        _draw_times(figure.subplots(), bench)
        return figure
    times, growth = figure.subplots(1, 2, width_ratios=(1.25, 1.0))
    _draw_times(times, bench)
    _draw_growth(growth, bench)
    return figure


def _draw_times(axes: Axes, bench: SolverBench) -> None:
    """A row per candidate, the quickest at the top: all its steps, with p50, p99 and the longest marked."""
    ranked = sorted(bench.candidates, key=lambda candidate: candidate.quantiles["p99"], reverse=True)
    rng = np.random.default_rng(0)  # spreads the dots of a row, as every time
    for row, candidate in enumerate(ranked):
        colour = _look(bench, candidate.name)[0]
        times = np.maximum(candidate.step_ms, 1e-4)  # a clock may read 0, which has no place on a logarithmic axis
        spread = row + rng.uniform(-0.28, 0.28, times.size)
        axes.plot(times, spread, ".", color=colour, markersize=2.0, alpha=0.35, rasterized=True)
        quantiles = candidate.quantiles
        for name, marker, size, edge in (("p50", "|", 11.0, 1.8), ("p99", "D", 4.5, 0.6), ("max", ">", 4.5, 0.6)):
            looks: Any = {"markersize": size, "markeredgewidth": edge, "markerfacecolor": colour}
            label = name if row == 0 else None
            axes.plot(quantiles[name], row, marker, color="#1c1e21", label=label, **looks)
    axes.axvline(bench.deadline_ms, color=BOUND, linestyle="--", linewidth=1.1)
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set_yticks(range(len(ranked)), [_label(bench, candidate) for candidate in ranked])
    axes.grid(axis="y", visible=False)
    axes.set_ylim(-0.6, len(ranked) - 0.4)
    axes.set_xlabel(f"time [ms], N = {bench.horizon}; dashed: the control period")
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, fontsize=8.5, handletextpad=0.3)


def _draw_growth(axes: Axes, bench: SolverBench) -> None:
    for growth in bench.growth:
        if not growth.whole:  # shorter at every horizon
            continue
        colour, dashes = _look(bench, growth.name)
        own = growth.name == bench.default.name
        axes.plot(
            growth.horizons,
            growth.p99,
            marker="o",
            markersize=3.0,
            color=colour,
            linestyle=dashes,
            linewidth=2.4 if own else 1.2,
            label=growth.name,
            zorder=3 if own else 2,
        )
    horizons = sorted({N for growth in bench.growth for N in growth.horizons})
    axes.axhline(bench.deadline_ms, color=BOUND, linestyle="--", linewidth=1.1)
    axes.set(xscale="log", yscale="log", xlabel="horizon N", ylabel="p99 of the step [ms]")
    axes.set_xticks(horizons, [str(N) for N in horizons])
    axes.set_xticks([], minor=True)
    axes.yaxis.set_major_formatter("{x:g}")
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8.0)


def _label(bench: SolverBench, candidate: CandidateResult) -> str:
    if candidate is bench.default:
        return f"{candidate.name}\n(default)"
    return f"{candidate.name}\n(the paper's)" if candidate.solver == PAPER_SOLVER else candidate.name


def _look(bench: SolverBench, name: str) -> tuple[str, str]:
    names = [candidate.name for candidate in bench.candidates]
    i = names.index(name)
    return LINES[i % len(LINES)], _DASHES[i // len(LINES) % len(_DASHES)]
