"""Several runs -> one directory to open and share: an HTML page that works offline, beside its videos and files."""

from __future__ import annotations

import itertools
import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from urllib.parse import quote

from quadsim.comparison import comparison_rows, outcome, required, run_names
from quadsim.conditions import verdict_cell
from quadsim.cost import CostStudy, cost_markdown, cost_sentences, cost_tables
from quadsim.errors import OutputError, ParameterError
from quadsim.figures import comparison_figure, write_cost_figures
from quadsim.flightlog import FLIGHT_FILE, HORIZON_FILE, PLANT_FILE, TIMING_FILE
from quadsim.inside import require_inside
from quadsim.narrative import comparison_sentences
from quadsim.outputs import write_json, write_text, writing
from quadsim.page import PAGE_FILE, render_page
from quadsim.palette import line_colour
from quadsim.plots import Plot, comparison_plots, cost_plots, plotly_script
from quadsim.rundir import (
    FIGURES_DIR,
    RECORDING_FILE,
    SCENARIO_FILE,
    SUMMARY_FILE,
    VIDEO_FILE,
    Run,
)
from quadsim.table import Cell, Grid, to_markdown

TABLE_FILE: Final = "comparison.md"
COST_FILE: Final = "cost.json"
COST_TABLES_FILE: Final = "cost.md"

KIND: Final = "comparison"
"""What `quadsim.outputs` calls such a directory."""
_FILES: Final = {
    SUMMARY_FILE: "summary (JSON)",
    SCENARIO_FILE: "scenario (TOML)",
    RECORDING_FILE: "recording (rerun)",
    FLIGHT_FILE: "control periods (Parquet)",
    TIMING_FILE: "clock times (Parquet)",
    PLANT_FILE: "plant (Parquet)",
    HORIZON_FILE: "predictions (Parquet)",
}
"""What is copied of a run directory beside its video and figures, and how links name it."""


@dataclass(frozen=True, kw_only=True)
class _RunView:
    """What the page's template is told of one run; `video` and the targets of `files` are relative URLs."""

    name: str
    colour: str
    directory: Path
    description: str
    outcome: Cell
    required: Cell
    verdict: Cell
    vehicle: str
    made_with: str
    video: str | None
    files: tuple[tuple[str, str], ...]


@dataclass(frozen=True, kw_only=True)
class _CostView:
    """What the page's template is told of a study of costs; the targets of `files` are relative URLs."""

    name: str
    sentences: tuple[str, ...]
    tables: tuple[Grid, ...]
    plots: tuple[Plot, ...]
    files: tuple[tuple[str, str], ...]


def write_comparison(runs: Sequence[Run], directory: Path, study: CostStudy | None = None) -> Path:
    """Write a comparison of runs, which appears complete or not at all.

    The directory holds `index.html`, the overlay `comparison.png` and `.svg`, the table `comparison.md`, and of each
    run its video `NAME.mp4` and a folder `NAME` of its other files; it can be moved or zipped as it is.  A study of
    what constraints cost adds a section to the page, `cost.json`, `cost.md` and the figures `cost_*.png` and `.svg`.

    Args:
        runs: one or more; aborted ones, and ones without video, recording or constraints, are welcome.
        directory: what to write; an earlier comparison or an empty directory there is replaced.
        study: what constraints cost on the course of these runs, where that was studied.

    Returns:
        The page, `directory/index.html`.

    Raises:
        ParameterError: no run is given.
        OutputError: the directory cannot be written, holds something else, or holds one of the runs.
        FileError: a link leads out of one of the runs.
    """
    if not runs:
        raise ParameterError("comparison", "runs", 0, "one or more")
    target = directory.resolve()
    for run in runs:
        require_inside(run.directory)  # copying follows links
        if run.directory.resolve().is_relative_to(target):
            raise OutputError(directory, f"it holds the run {run.directory}, which must stay; choose another --out")
    names = run_names(runs)
    rows = comparison_rows(runs)
    with writing(directory, KIND) as partial:
        comparison_figure(runs, partial)
        write_text(partial / TABLE_FILE, to_markdown(rows, names))
        views = [
            _place(run, name, folder, line_colour(i), partial)
            for i, (run, name, folder) in enumerate(zip(runs, names, _folder_names(names), strict=True))
        ]
        plots = comparison_plots(runs)
        page = render_page(
            "comparison.html.j2",
            KIND,
            title=" and ".join(names) if len(names) < 3 else f"{len(names)} runs: {', '.join(names)}",
            runs=views,
            sentences=comparison_sentences(runs),
            groups=[(group, list(of_group)) for group, of_group in itertools.groupby(rows, lambda row: row.group)],
            plots=plots,
            cost=None if study is None else _place_study(study, partial),
            plotly=plotly_script() if plots or study is not None else "",
            figure="comparison.svg",
            table=TABLE_FILE,
        )
        write_text(partial / PAGE_FILE, page)
    return directory / PAGE_FILE


def _folder_names(names: Sequence[str]) -> list[str]:
    """A distinct name of plain characters for each run's files."""
    folders: list[str] = []
    for name in names:
        plain = re.sub(r"[^a-z0-9_-]+", "-", name.lower()).strip("-") or "run"
        numbered = itertools.chain([plain], (f"{plain}-{i}" for i in itertools.count(2)))
        folders.append(next(folder for folder in numbered if folder not in folders))
    return folders


def _place(run: Run, name: str, folder: str, colour: str, page_directory: Path) -> _RunView:
    """Copy what a run has to offer beside the page, and say where it is."""
    place = page_directory / folder
    place.mkdir()
    files = []
    for file, label in _FILES.items():
        if (run.directory / file).is_file():
            shutil.copyfile(run.directory / file, place / file)
            files.append((label, quote(f"{folder}/{file}")))
    if (run.directory / FIGURES_DIR).is_dir():
        shutil.copytree(run.directory / FIGURES_DIR, place / FIGURES_DIR)
        figures = sorted((place / FIGURES_DIR).glob("*.svg"))
        files += [(f"figure: {path.stem}", quote(path.relative_to(page_directory).as_posix())) for path in figures]
    video = None
    if (run.directory / VIDEO_FILE).is_file():
        video = f"{folder}.mp4"
        shutil.copyfile(run.directory / VIDEO_FILE, page_directory / video)
    return _RunView(
        name=name,
        colour=colour,
        directory=run.directory,
        description=run.summary.get("description", ""),
        outcome=outcome(run.summary),
        required=required(run.summary),
        verdict=verdict_cell(run.summary),
        vehicle=f"Vehicle: {run.vehicle.description or run.vehicle.name}, {run.vehicle.mass:g} kg",
        made_with=_made_with(run),
        video=None if video is None else quote(video),
        files=tuple(files),
    )


def _place_study(study: CostStudy, page_directory: Path) -> _CostView:
    """Write a study's files beside the page, and say what the page is to show of it."""
    sentences = cost_sentences(study)
    write_json(page_directory / COST_FILE, study.to_json())
    text = f"# What do constraints cost?\n\n{cost_markdown(study, sentences)}"
    write_text(page_directory / COST_TABLES_FILE, text)
    figures = [path for path in write_cost_figures(study, page_directory) if path.suffix == ".svg"]
    return _CostView(
        name=study.name,
        sentences=tuple(sentences),
        tables=tuple(cost_tables(study)),
        plots=tuple(cost_plots(study)),
        files=(
            (COST_FILE, COST_FILE),
            (COST_TABLES_FILE, COST_TABLES_FILE),
            *((f"figure: {path.stem}", path.name) for path in figures),
        ),
    )


def _made_with(run: Run) -> str:
    """Versions and machine: what timings, and the last digits, depend on."""
    versions, machine = run.summary.get("versions", {}), run.summary.get("machine", {})
    packages = [f"{name} {versions[name]}" for name in ("quadsim", "mujoco", "piqp") if name in versions]
    where = f"{machine['processor']}, {machine['cores']} cores" if {"processor", "cores"} <= machine.keys() else ""
    return " on ".join(filter(None, (", ".join(packages), where)))
