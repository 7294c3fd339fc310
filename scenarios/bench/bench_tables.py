"""The measurements of `quadsim bench` -> tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from quadsim.report.table import ABSENT, Cell, Grid, Mark, line
from scenarios.bench.bench_results import (
    FITTED_FROM,
    FlightProfile,
    RenderProfile,
    SolverBench,
    StageLength,
    Target,
)

PAPER_SOLVER: Final = "qpoases"  # the solver of the paper


def solver_tables(bench: SolverBench) -> list[Grid]:
    """Candidates, the growth of their steps, the length of a stage, and the targets."""
    return [
        _candidates(bench),
        *([_growth(bench)] if bench.growth else []),
        _stages(bench.stages),
        targets_table("Targets for the solvers", solver_targets(bench)),
    ]


def flight_tables(profile: FlightProfile) -> list[Grid]:
    """Where the time of a flight goes, and the targets."""
    whole = sum(profile.pieces.values())
    place = "on one core" if profile.cores == 1 else "on whatever cores the system gives"
    pieces = [(name, seconds, f"{100 * seconds / whole:.0f} %") for name, seconds in profile.pieces.items()]
    pieces += [
        ("the flight, with clocks in it", whole, "100 %"),
        (f"the flight, best of {profile.repeats}", profile.best, ABSENT),
        ("the flight, median", profile.median, ABSENT),
        ("set-up before it", profile.setup_s, ABSENT),
        ("audit after it", profile.audit_s, ABSENT),
    ]
    grid = Grid(
        key="flight",
        title="Where the time of a flight goes",
        head=(f"{profile.duration:g} s of {profile.scenario}", "time [s]", "share"),
        lines=tuple(line(name, f"{seconds:.3f}", share) for name, seconds, share in pieces),
        note=f"Solver: {profile.solver or 'none, a gain'}; {place}; pieces are medians over {profile.repeats} flights.",
    )
    return [grid, targets_table("Targets for a flight", flight_targets(profile))]


def render_tables(profile: RenderProfile) -> list[Grid]:
    """What a film costs, and the targets."""
    grid = Grid(
        key="render",
        title="What a film costs",
        head=(f"{profile.width}x{profile.height} at {profile.fps} fps, through {profile.backend.upper()}", ""),
        lines=(
            line("frames filmed", str(profile.frames)),
            line("rendering processes", str(profile.workers)),
            line("wall time per frame, all processes together [ms]", f"{profile.frame_ms:.1f}"),
            line("wall time before the first frame [s]", f"{profile.start_s:.2f}"),
            line("60 s of film [s]", f"{profile.film_s(60.0):.1f}"),
        ),
    )
    return [grid, targets_table("Targets for a film", render_targets(profile))]


def _candidates(bench: SolverBench) -> Grid:
    names = ("p50", "p95", "p99", "max")
    fastest = {name: min(candidate.quantiles[name] for candidate in bench.candidates) for name in names}
    lines = []
    for each in bench.candidates:
        quantiles = each.quantiles
        marks = {name: Mark.BEST if value == fastest[name] else Mark.NONE for name, value in quantiles.items()}
        lines.append(
            line(
                f"{each.name} (default)" if each is bench.default else each.name,
                *(Cell(text=_milliseconds(value), mark=marks[name]) for name, value in quantiles.items()),
                _milliseconds(each.raw_max_ms),
                f"{quantiles['p99'] / bench.default.quantiles['p99']:.3g}",
                Cell(text=str(each.failures), mark=Mark.BAD if each.failures else Mark.NONE),
                *(ABSENT if value is None else f"{value:.0e}" for value in (each.input_error, each.kkt)),
                f"{each.repeats}x",
            )
        )
    return Grid(
        key="candidates",
        title="The candidates",
        head=("whole step [ms]", *names, *("raw max", "p99 ratio", "failures", "u0 error", "KKT", "timed")),
        lines=tuple(lines),
        note=_how(bench),
    )


def _how(bench: SolverBench) -> str:
    which = "All" if bench.asked == bench.flown else f"{bench.asked} of the"
    ways = sorted(bench.default.ways.items(), key=lambda pair: -pair[1])
    shares = ", ".join(f"by {way} {count}" for way, count in ways)
    text = (
        f"{which} {bench.flown} control periods of `{bench.scenario}`, N = {bench.horizon}, timed as a flight "
        "sees them: between two steps the plant flies a period, and each is the median of its repeats; raw max is the "
        "longest of all steps, the machine's stalls included. One process, one thread; "
        "candidates take their turns in random order. Failures are periods without an optimum. Over the others, u0 "
        "error [rad/s] is the largest of the first input, from an optimum in closed form whose own KKT residual is at "
        f"most {bench.reference_kkt:.0e}, and KKT the worst residual of the candidate's answer to its own QP."
    )
    answered = [f"Periods that the default answered {shares}."] if bench.default.shortcut else []
    return " ".join([text, *answered, *(f"Left out: {name}, {why}." for name, why in bench.left_out.items())])


def _growth(bench: SolverBench) -> Grid:
    horizons = sorted({N for growth in bench.growth for N in growth.horizons})
    lines = []
    for growth in bench.growth:
        times = dict(zip(growth.horizons, zip(growth.p50, growth.p99, strict=True), strict=True))
        pairs = [" / ".join(map(_milliseconds, times[N])) if N in times else ABSENT for N in horizons]
        exponents = [growth.exponent(name) for name in ("p50", "p99")]
        fitted = [f"{exponent:.2f}" for exponent in exponents if exponent is not None]
        lines.append(line(growth.label, *pairs, " / ".join(fitted) or ABSENT))
    failed = dict.fromkeys(
        f"{growth.name}: " + ", ".join(f"{count} at N = {N}" for N, count in growth.failures.items())
        for growth in bench.growth
        if growth.failures
    )
    dropped = dict.fromkeys(f"{growth.name}: {growth.dropped}" for growth in bench.growth if growth.dropped)
    listed = {"Periods without an optimum": failed, "Dropped": dropped}
    note = (
        f"{bench.growth_asked} control periods at each N, the problem and its reference made anew; at N = "
        f"{bench.horizon} those of the candidates' table; growth: the exponents of N that fit p50 and p99 from N = "
        f"{FITTED_FROM} on."
    )
    return Grid(
        key="growth",
        title="Growth with the horizon",
        head=("p50 / p99 of the whole step [ms]", *(f"N = {N}" for N in horizons), "growth"),
        lines=tuple(lines),
        note=" ".join([note, *(f"{what}: {'; '.join(entries)}." for what, entries in listed.items() if entries)]),
    )


def _stages(stages: Sequence[StageLength]) -> Grid:
    default = next(stage for stage in stages if stage.default)
    lines = []
    for stage in stages:
        name = "condensed, dense" if stage.steps is None else str(stage.steps)
        label = Cell(text=f"{name} (default)", mark=Mark.BEST) if stage is default else name
        ratio = f"{stage.p50 / default.p50:.2f}"
        lines.append(line(label, str(stage.variables), f"{stage.p50:.3g}", f"{stage.p99:.3g}", ratio))
    return Grid(
        key="stages",
        title="How many steps make a stage",
        head=("steps per stage", "variables", "p50 [ms]", "p99 [ms]", "p50, as a ratio to the default"),
        lines=tuple(lines),
        note="PIQP alone, timed in the same way, on the periods whose QP has active constraints. Its multistage "
        "factorisation costs less the fewer stages there are, and more the larger each is; the paper's own form is the "
        "condensed one.",
    )


def targets_table(title: str, targets: Sequence[Target]) -> Grid:
    """Targets, what was measured, and whether each is met."""
    met, missed = Cell(text="met", mark=Mark.GOOD), Cell(text="missed", mark=Mark.BAD)
    return Grid(
        key="targets",
        title=title,
        head=("quantity", "target", "measured", "verdict"),
        lines=tuple(line(*target[:3], met if target.met else missed) for target in targets),
    )


def _milliseconds(value: float) -> str:
    """Three digits: a step takes from 20 microseconds to a second."""
    return f"{value:.3g}" if value < 100.0 else f"{value:.0f}"


def solver_targets(bench: SolverBench) -> list[Target]:
    """Speed and exactness of the default controller, against the other solvers and the horizon."""
    default, own = bench.default, bench.default.quantiles
    error, failures = default.input_error, default.failures
    others = [candidate for candidate in bench.candidates if candidate.solver != default.solver]
    targets = [
        Target("default, p50", "<= 0.05 ms", f"{own['p50']:.3f} ms", own["p50"] <= 0.05),
        Target("default, p99", "<= 0.6 ms", f"{own['p99']:.2f} ms", own["p99"] <= 0.6),
        Target("default, max", "<= 2 ms", f"{own['max']:.2f} ms", own["max"] <= 2.0),
        Target(
            "default, worst first input",
            "<= 1e-3 rad/s",
            ABSENT if error is None else f"{error:.0e} rad/s",
            error is not None and error <= 1e-3,
        ),
        Target("default, periods without an optimum", "0", str(failures), failures == 0),
    ]
    for whose, shortcut in (("every other solver's", False), ("every other's with the same shortcuts", True)):
        rivals = [candidate for candidate in others if candidate.shortcut == shortcut]
        for name in ("p99", "max") if rivals else ():
            other, nearest = min((rival.quantiles[name], rival.name) for rival in rivals)
            required, measured = f"< {other:.2f} ms ({nearest})", f"{own[name]:.2f} ms"
            targets.append(Target(f"default, {name} below {whose}", required, measured, own[name] < other))
    for candidate in others:
        if candidate.solver == PAPER_SOLVER:
            ratio = candidate.quantiles["p99"] / own["p99"]
            what = "p99 of qpOASES, the paper's solver, to the default's"
            targets.append(Target(what, ">= 15", f"{ratio:.0f}", ratio >= 15.0))
    for growth in bench.growth:
        for name in ("p50", "p99") if growth.name == default.name else ():
            if (exponent := growth.exponent(name)) is not None:
                what = f"default, steps by {growth.kind}: growth of {name} with N up to {growth.horizons[-1]}"
                met = exponent <= 1.2 and not growth.failures
                targets.append(Target(what, "<= N^1.2", f"N^{exponent:.2f}", met))
    return targets


def flight_targets(profile: FlightProfile) -> list[Target]:
    """The wall time of a minute of flight."""
    minute = profile.best * 60.0 / profile.duration
    what = f"60 s of {profile.scenario} simulated, on one core, the best of {profile.repeats}"
    return [Target(what, "<= 1.2 s", f"{minute:.2f} s", minute <= 1.2)]


def render_targets(profile: RenderProfile) -> list[Target]:
    """The wall time of a minute of film on two cores."""
    minute = profile.film_s(60.0)
    what = f"60 s of film, {profile.width}x{profile.height} at {profile.fps} fps, {profile.workers} processes"
    return [Target(what, "<= 50 s on 2 cores", f"{minute:.0f} s", minute <= 50.0)]
