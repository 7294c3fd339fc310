"""What `import quadsim` hands out of benchmarks: each measures on this machine, all candidates in one run."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mpc.solvers import SOLVERS
from quadsim.outputs import writing
from scenarios.api import as_scenario
from scenarios.progress import Progress, reporting
from scenarios.schema.scenario import Scenario

if TYPE_CHECKING:
    from scenarios.bench.bench_results import FlightProfile, RenderProfile, SolverBench
    from scenarios.bench.campaigns import CampaignProfile
    from scenarios.bench.mismatch.survival import MismatchBench
    from scenarios.bench.speed import SpeedBench


def _beginning(out: str | Path | None) -> AbstractContextManager[Path | None]:
    """The directory of the results, refused before anything is measured where it cannot be; None for none."""
    return nullcontext() if out is None else writing(out, overwrite=True)


def bench_solvers(
    scenario: Scenario | str | Path = "paper-constrained",
    *,
    out: str | Path | None = None,
    solvers: Sequence[str] = (),
    repeats: int = 5,
    horizons: Sequence[int] = (10, 20, 50, 100, 200),
    stride: int = 1,
    progress: Progress | bool = True,
) -> SolverBench:
    """Time every installed QP solver on the QPs of one flight, judged by optima in closed form.

    Args:
        scenario: by a constrained controller, or its name or file.
        out: directory for the results and their figure; nothing is written where absent.
        solvers: names of `catalogue().solvers`; all where empty.
        repeats: how often each question is put, at most.
        horizons: N, for how times grow with it; empty for none.
        stride: one segment of 20 periods in every `stride` is timed.
        progress: as of `fly`.

    Returns:
        Times [ms], residuals and failures of each solver, in `candidates`.

    Raises:
        InputError: an argument is wrong, or the flight is not one by a constrained controller.
        OutputError: the directory cannot be written.

    Examples:
        >>> import quadsim
        >>> short = quadsim.load("paper-constrained").replace({"duration": 1.0, "controller.horizon": 20})
        >>> found = quadsim.bench_solvers(short, solvers=["piqp-multistage"], repeats=1, horizons=[], stride=2)
        >>> found.deadline_ms
        50.0
    """
    from scenarios.bench import solvers as bench

    options: dict[str, Any] = {"solvers": tuple(solvers or SOLVERS), "repeats": repeats, "stride": stride}
    scenario = as_scenario(scenario)
    with _beginning(out) as directory, reporting(progress) as report:
        found = bench.bench_solvers(scenario, horizons=horizons, progress=report, **options)
        if directory is not None:
            bench.write_bench(found, directory)
    return found


def bench_flight(
    scenario: Scenario | str | Path = "paper-constrained", *, repeats: int = 5, progress: Progress | bool = True
) -> FlightProfile:
    """Measure where the time of a flight goes: physics, controller, solver and the rest.

    Args:
        scenario: what is flown, or its name or file.
        repeats: flights.
        progress: as of `fly`.

    Returns:
        Seconds of the whole and of its parts.

    Raises:
        InputError: no repeat is requested, or the flight does not go to its end.

    Examples:
        >>> import quadsim
        >>> found = quadsim.bench_flight(quadsim.load("hover").replace({"duration": 1.0}), repeats=1)
        >>> 0.0 < found.best <= found.median  # [s]
        True
    """
    from scenarios.bench.flight import bench_flight as measure

    with reporting(progress) as report:
        return measure(as_scenario(scenario), repeats=repeats, progress=report)


def bench_render(
    scenario: Scenario | str | Path = "paper-constrained",
    *,
    seconds: float = 4.0,
    workers: int | None = None,
    progress: Progress | bool = True,
) -> RenderProfile:
    """Measure what a film costs.

    Args:
        scenario: what is flown and filmed, or its name or file.
        seconds: of film [s].
        workers: rendering processes; one per usable core where absent.
        progress: as of `fly`.

    Returns:
        The time of a frame, `frame_ms` [ms], and of the start of the processes.

    Raises:
        InputError: an argument is out of range.
        RenderingUnavailableError: nothing can render here.

    Examples:
        >>> import quadsim
        >>> quadsim.bench_render("hover", seconds=0.2, workers=1).frame_ms > 0.0
        True
    """
    from scenarios.bench.film import bench_render as measure

    scenario = as_scenario(scenario)
    with reporting(progress) as report:
        return measure(scenario, seconds=seconds, workers=workers, progress=report)


def bench_ladder(
    scenario: str | Path = "paper-constrained",
    changes: Sequence[str] = (),
    *,
    out: str | Path | None = None,
    quick: bool = False,
    workers: int | None = None,
    progress: Progress | bool = True,
) -> MismatchBench:
    """Fly every controller in every condition, from rotor lag to a worn rotor: what does each survive?

    Args:
        scenario: name or file of a constrained one whose bounds on roll and pitch are the same.
        changes: of it, texts `dotted.path=value`.
        out: directory for the results and their figure; nothing is written where absent.
        quick: three controllers and three conditions, 12 s each.
        workers: processes; one per usable core where absent.
        progress: as of `fly`.

    Returns:
        How each flight ended, in `flights` by controller and condition.

    Raises:
        InputError: the scenario cannot be flown so.
        OutputError: the directory cannot be written.

    Examples:
        >>> import quadsim
        >>> found = quadsim.bench_ladder(quick=True)
        >>> len(found.controllers), len(found.conditions), len(found.flights)
        (3, 3, 9)
    """
    from scenarios.bench.mismatch import benchmark

    with _beginning(out) as directory, reporting(progress) as report:
        found = benchmark.run_mismatch(str(scenario), changes, quick=quick, workers=workers, progress=report)
        if directory is not None:
            benchmark.write_mismatch(found, directory)
    return found


def bench_speed(*, quick: bool = False, workers: int | None = None, progress: Progress | bool = True) -> SpeedBench:
    """Fly every controller on agile courses at growing speed: where does linear control end?

    Args:
        quick: two controllers on one course, at two speeds.
        workers: processes; one per usable core where absent.
        progress: as of `fly`.

    Returns:
        How each flight went, in `flights` by course, speed [m/s] and controller.

    Raises:
        InputError: the number of processes is none.

    Examples:
        >>> import quadsim
        >>> found = quadsim.bench_speed(quick=True)
        >>> linear, nonlinear = (found.flights["loop, drag", 6.0, law].error for law in ("LQR", "nonlinear"))  # [m]
        >>> nonlinear < 0.2 * linear
        True
    """
    from scenarios.bench.speed import run_speeds

    with reporting(progress) as report:
        return run_speeds(quick=quick, workers=workers, progress=report)


def bench_campaign(
    scenario: Scenario | str | Path = "paper-constrained",
    *,
    flights: int = 40,
    rounds: int = 3,
    sizes: Sequence[int] = (10, 100, 1000, 10000),
    progress: Progress | bool = True,
) -> CampaignProfile:
    """Measure what many flights cost, by one worker process and by two.

    Args:
        scenario: what is flown, or its name or file.
        flights: per worker and round.
        rounds: of one worker and of two.
        sizes: flights of ever larger campaigns; empty for none.
        progress: as of `fly`.

    Returns:
        Seconds and memory of each campaign.

    Raises:
        InputError: nothing is requested.

    Examples:
        >>> import quadsim
        >>> short = quadsim.load("hover").replace({"duration": 1.0})
        >>> found = quadsim.bench_campaign(short, flights=2, rounds=1, sizes=[])
        >>> len(found.rounds)
        1
    """
    from scenarios.bench.campaigns import bench_campaign as measure

    scenario = as_scenario(scenario)
    with reporting(progress) as report:
        return measure(scenario, flights=flights, rounds=rounds, sizes=sizes, progress=report)
