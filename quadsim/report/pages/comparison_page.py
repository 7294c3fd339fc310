"""Several runs -> one directory to open and share: an HTML page that works offline, beside its videos and files."""

from __future__ import annotations

import itertools
import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

from quadsim.errors import OutputError, ParameterError
from quadsim.flight.parquet import FLIGHT_FILE, HORIZON_FILE, PLANT_FILE, TIMING_FILE
from quadsim.flight.rundir import FIGURES_DIR, RECORDING_FILE, SCENARIO_FILE, SUMMARY_FILE, VIDEO_FILE, Run
from quadsim.flight.summary import require_inside
from quadsim.outputs import writing
from quadsim.report.comparison import comparison_rows, mismatch, outcome, required, run_names, verdict_cell
from quadsim.report.figures.flight_figures import comparison_figure
from quadsim.report.narrative import comparison_sentences
from quadsim.report.pages.page import PAGE_FILE, render_page
from quadsim.report.palette import line_colour
from quadsim.report.plots.flight_plots import comparison_plots
from quadsim.report.plots.panels import Plot, plotly_script
from quadsim.report.table import Grid, to_markdown

TABLE_FILE: Final = "comparison.md"

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
class CostSection:
    """What the page shows of a study of what constraints cost; the targets of `files` are relative URLs."""

    name: str
    sentences: tuple[str, ...]
    tables: tuple[Grid, ...]
    plots: tuple[Plot, ...]
    files: tuple[tuple[str, str], ...]


def write_comparison(
    runs: Sequence[Run],
    directory: Path,
    cost: Callable[[Path], CostSection] | None = None,
    *,
    overwrite: bool = False,
) -> Path:
    """Write a comparison of runs, which appears complete or not at all.

    The directory holds `index.html`, the overlay `comparison.png` and `.svg`, the table `comparison.md`, and of each
    run its video `NAME.mp4` and a folder `NAME` of its other files; it can be moved or zipped as it is.

    Args:
        runs: one or more; aborted ones, and ones without video, recording or constraints, are welcome.
        directory: what to write.
        cost: writes the files of a study of what constraints cost into a directory, and gives the page's section.
        overwrite: whether to replace an earlier output there.

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
    with writing(directory, overwrite=overwrite) as partial:
        comparison_figure(runs, partial)
        (partial / TABLE_FILE).write_text(to_markdown(rows, names), encoding="utf-8")
        views = [
            _place(run, name, folder, line_colour(i), partial)
            for i, (run, name, folder) in enumerate(zip(runs, names, _folder_names(names), strict=True))
        ]
        plots = comparison_plots(runs)
        page = render_page(
            "comparison.html.j2",
            "comparison",
            title=" and ".join(names) if len(names) < 3 else f"{len(names)} runs: {', '.join(names)}",
            runs=views,
            sentences=comparison_sentences(runs),
            groups=[(group, list(of_group)) for group, of_group in itertools.groupby(rows, lambda row: row.group)],
            plots=plots,
            cost=None if cost is None else cost(partial),
            plotly=plotly_script() if plots or cost is not None else "",
            figure="comparison.svg",
            table=TABLE_FILE,
        )
        (partial / PAGE_FILE).write_text(page, encoding="utf-8")
    return directory / PAGE_FILE


def _folder_names(names: Sequence[str]) -> list[str]:
    """A distinct name of plain characters for each run's files."""
    folders: list[str] = []
    for name in names:
        plain = re.sub(r"[^a-z0-9_-]+", "-", name.lower()).strip("-") or "run"
        numbered = itertools.chain([plain], (f"{plain}-{i}" for i in itertools.count(2)))
        folders.append(next(folder for folder in numbered if folder not in folders))
    return folders


def _place(run: Run, name: str, folder: str, colour: str, page_directory: Path) -> dict[str, Any]:
    """Copy what a run has to offer beside the page; the template's context of the run, with relative URLs."""
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
    return {
        "name": name,
        "colour": colour,
        "directory": run.directory,
        "description": run.summary.get("description", ""),
        "outcome": outcome(run.summary),
        "required": required(run.summary),
        "verdict": verdict_cell(run.summary),
        "vehicle": ", modelled with ".join(
            [f"Vehicle: {run.vehicle.description or run.vehicle.name}, {run.vehicle.mass:g} kg", *mismatch(run.summary)]
        ),
        "made_with": _made_with(run),
        "video": None if video is None else quote(video),
        "files": files,
    }


def _made_with(run: Run) -> str:
    """Versions and machine: what timings, and the last digits, depend on."""
    versions, machine = run.summary.get("versions", {}), run.summary.get("machine", {})
    packages = [f"{name} {versions[name]}" for name in ("quadsim", "mujoco", "piqp") if name in versions]
    where = f"{machine['processor']}, {machine['cores']} cores" if {"processor", "cores"} <= machine.keys() else ""
    return " on ".join(filter(None, (", ".join(packages), where)))
