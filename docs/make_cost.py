"""docs/constraints-cost.md and its figures; `docs/make_performance.py` times and calls it."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

from make_numbers import ROOT, Table, markdown, write_page

from quadsim.flight.metrics import percentiles
from scenarios.bench.bench_results import SolverBench
from scenarios.cost.cost_figures import write_cost_figures
from scenarios.cost.cost_tables import cost_markdown
from scenarios.cost.measure import SOLVERS_TIMED
from scenarios.cost.section import cost_sentences
from scenarios.cost.study import CandidateTimes, CostStudy


def timed(bench: SolverBench) -> list[CandidateTimes]:
    """The steps of the study, as the bench has timed them: each time is measured once for all documents."""
    assert bench.gain_ms is not None
    repeats = bench.default.repeats
    gain = CandidateTimes(
        name="unconstrained gain",
        step_ms=bench.gain_ms,
        statuses=("unconstrained",) * bench.gain_ms.size,
        repeats=repeats,
    )
    alone = {each.solver: each for each in bench.candidates if not each.shortcut}
    named = {"constrained, as flown": bench.default}
    named |= {f"QP by {solver}": alone[solver] for solver in SOLVERS_TIMED if solver in alone}
    return [
        gain,
        *(
            CandidateTimes(name=name, step_ms=each.step_ms, statuses=each.answered, repeats=each.repeats)
            for name, each in named.items()
        ),
    ]


def answer(study: CostStudy) -> Table:
    """What constraints cost and what they buy, in a few lines."""

    def pair(label: str, keys: Sequence[str], form: str = ".3g") -> tuple[str, ...]:
        flights = (study.constrained, study.unconstrained)
        return (label, *(", ".join(format(flight.numbers[key], form) for key in keys) for flight in flights))

    gain, flown, *by_qp = study.candidates
    times = {candidate.name: percentiles(candidate.step_ms) for candidate in study.candidates}
    text = {name: ", ".join(f"{found[key]:.3g}" for key in ("p50", "p99", "max")) for name, found in times.items()}
    lost = [f"{point.value:g}" for point in study.horizons.points if not point.unconstrained.completed]
    completed = [f"{point.value:g}" for point in study.horizons.points if not point.constrained.completed]
    rows: Table = [
        (f"{study.name}, same weights and horizon", "with its constraints", "without"),
        pair("RMS error x, y, z [m]", ("rmse_x", "rmse_y", "rmse_z")),
        pair("peak roll or pitch [deg]", ("tilt_plant",)),
        pair("highest speed, largest step [rad/s]", ("speed_max", "step_max")),
        pair("total variation of the commands [rad/s]", ("total_variation",), ".0f"),
        ("periods without a QP", f"{flown.shortcut.sum()} of {flown.shortcut.size}", "all"),
        ("horizons N at which the vehicle is lost", ", ".join(completed) or "none", ", ".join(lost) or "none"),
        ("controller step: median, p99, max [ms]", text[flown.name], text[gain.name]),
        ("largest loop rate [Hz]", *(f"{each.rate('max'):.0f}" for each in (flown, gain))),
    ]
    rows += [(f"{each.name} in every period: the same [ms]", text[each.name], "-") for each in by_qp]
    return rows


def write_cost(study: CostStudy) -> None:
    """docs/constraints-cost.md with its figures."""
    sentences = cost_sentences(study)
    with tempfile.TemporaryDirectory() as scratch:
        drawn = [path for path in write_cost_figures(study, Path(scratch)) if path.suffix == ".svg"]
        for path in drawn:
            shutil.copyfile(path, ROOT / "docs" / path.name)
    write_page(
        "constraints-cost.md",
        "# What do constraints cost?\n\nMade by `make numbers` on one machine "
        f"({study.machine['processor']}, {study.machine['cores']} cores); nothing here is typed by hand. The same "
        "section, with plots\nto zoom into, is on the page of `quadsim compare paper-unconstrained paper-constrained "
        "--out DIR`.\n",
        "The paper leaves the question open. It compares two controllers that differ in weights and horizon as well "
        "as in\nconstraints; here the constrained one is held against itself without them.\n",
        markdown(answer(study)),
        "Where the unconstrained optimum satisfies every constraint it is the answer, without a QP.\n",
        cost_markdown(study, sentences),
        *(f"![{path.stem}]({path.name})\n" for path in drawn),
    )
