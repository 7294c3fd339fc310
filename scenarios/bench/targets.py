"""Targets for the project's speed, compared with what a benchmark measured."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from scenarios.bench.bench_results import CandidateResult, FlightProfile, RenderProfile, SolverBench, Target

PAPER_SOLVER: Final = "qpoases"  # the solver of the paper


def solver_targets(bench: SolverBench) -> list[Target]:
    """Speed and exactness of the default controller, against the other solvers and the horizon."""
    default = bench.default
    own = default.quantiles
    others = [candidate for candidate in bench.candidates if candidate.solver != default.solver]
    targets = [
        Target(what="default, p50", asked="<= 0.05 ms", measured=f"{own['p50']:.3f} ms", met=own["p50"] <= 0.05),
        Target(what="default, p99", asked="<= 1.6 ms", measured=f"{own['p99']:.2f} ms", met=own["p99"] <= 1.6),
        Target(
            what="default, worst first input",
            asked="<= 1e-3 rad/s",
            measured="-" if default.input_error is None else f"{default.input_error:.0e} rad/s",
            met=default.input_error is not None and default.input_error <= 1e-3,
        ),
        Target(
            what="default, periods without an optimum",
            asked="0",
            measured=str(default.failures),
            met=default.failures == 0,
        ),
    ]
    alone = [candidate for candidate in others if not candidate.shortcut]
    quick = [candidate for candidate in others if candidate.shortcut]
    for whose, rivals in (("every other solver's", alone), ("every other's with the same shortcuts", quick)):
        targets += [_below_others(default, rivals, quantile, whose) for quantile in ("p99", "max") if rivals]
    for candidate in others:
        if candidate.solver == PAPER_SOLVER:
            ratio = candidate.quantiles["p99"] / own["p99"]
            what = "p99 of qpOASES, the paper's solver, to the default's"
            targets.append(Target(what=what, asked=">= 15", measured=f"{ratio:.0f}", met=ratio >= 15.0))
    for growth in bench.growth:
        for quantile in ("p50", "p99") if growth.name == default.name else ():
            exponent = growth.exponent(quantile)
            if exponent is not None:
                what = f"default, steps by {growth.kind}: growth of {quantile} with N up to {growth.horizons[-1]}"
                targets.append(
                    Target(
                        what=what,
                        asked="<= N^1.2",
                        measured=f"N^{exponent:.2f}",
                        met=exponent <= 1.2 and not growth.failures,
                    )
                )
    return targets


def flight_targets(profile: FlightProfile) -> list[Target]:
    """The wall time of a minute of flight."""
    minute = profile.best * 60.0 / profile.duration
    return [
        Target(
            what=f"60 s of {profile.scenario} simulated, on one core, the best of {profile.repeats}",
            asked="<= 1.2 s",
            measured=f"{minute:.2f} s",
            met=minute <= 1.2,
        )
    ]


def render_targets(profile: RenderProfile) -> list[Target]:
    """The wall time of a minute of film on two cores."""
    minute = profile.film_s(60.0)
    return [
        Target(
            what=f"60 s of film, {profile.width}x{profile.height} at {profile.fps} fps, {profile.workers} processes",
            asked="<= 60 s on 2 cores",
            measured=f"{minute:.0f} s",
            met=minute <= 60.0,
        )
    ]


def _below_others(default: CandidateResult, others: Sequence[CandidateResult], quantile: str, whose: str) -> Target:
    nearest = min(others, key=lambda candidate: candidate.quantiles[quantile])
    own, other = default.quantiles[quantile], nearest.quantiles[quantile]
    return Target(
        what=f"default, {quantile} below {whose}",
        asked=f"< {other:.2f} ms ({nearest.name})",
        measured=f"{own:.2f} ms",
        met=own < other,
    )
