"""Several runs -> one directory to open and share: an HTML page that works offline, beside its videos and files."""

from __future__ import annotations

import itertools
import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Final
from urllib.parse import quote

from quadsim.errors import OutputError, ParameterError
from quadsim.flight.parquet import FLIGHT_FILE, HORIZON_FILE, PLANT_FILE, TIMING_FILE
from quadsim.flight.record import FlightRecord
from quadsim.flight.rundir import (
    FIGURES_DIR,
    RECORDING_FILE,
    SCENARIO_FILE,
    SUMMARY_FILE,
    VIDEO_FILE,
    require_inside,
)
from quadsim.outputs import optional, writing
from quadsim.palette import line_colour
from quadsim.report.comparison import comparison_rows, conclusion, distinct_courses, mismatch, run_names
from quadsim.report.figure import Scene
from quadsim.report.flight_figures import overview, page_figures
from quadsim.report.page import PAGE_FILE, RunView, Section, render_page
from quadsim.report.table import to_markdown
from quadsim.report.to_matplotlib import write_pngs
from quadsim.report.to_plotly import scene_to_plot, to_plot

OVERVIEW_FILE: Final = "comparison.png"
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


def write_comparison(
    runs: Sequence[FlightRecord], directory: Path, *, notes: Sequence[str] = (), overwrite: bool = False
) -> Path:
    """Write a comparison of runs, which appears complete or not at all; returns the page, `directory/index.html`.

    `notes` are sentences at its top.

    The directory holds the page, the overlay `comparison.png`, the table `comparison.md`, and of each run its video
    `NAME.mp4` with its poster `NAME.jpg`, and a folder `NAME` of its other files; it can be moved or zipped as it is.
    Runs that were aborted, and runs without video, recording or constraints are welcome.

    Raises:
        ParameterError: no run is given.
        OutputError: the directory cannot be written, holds something else, or holds one of the runs.
        FileError: a link leads out of one of the runs.
    """
    if not runs:
        raise ParameterError("comparison", "runs", 0, "one or more")
    target = directory.resolve()
    for run in runs:
        if run.directory is None:
            continue
        require_inside(run.directory)  # copying follows links
        if run.directory.resolve().is_relative_to(target):
            raise OutputError(directory, f"it holds the run {run.directory}, which must stay; choose another --out")
    names = run_names(runs)
    rows = comparison_rows(runs)
    with writing(directory, overwrite=overwrite) as partial:
        (partial / TABLE_FILE).write_text(to_markdown(rows, names), encoding="utf-8")
        with optional(OVERVIEW_FILE):
            write_pngs([overview(runs)], partial)
        views = [
            _place(run, name, folder, line_colour(i), partial)
            for i, (run, name, folder) in enumerate(zip(runs, names, _folder_names(names), strict=True))
        ]
        courses = len(distinct_courses(runs))
        warning = f"The runs follow {courses} different courses, so their errors are not like for like."
        figures = []
        for figure in page_figures(runs):
            figures.append(
                scene_to_plot(figure) if isinstance(figure, Scene) else to_plot(figure, labelled=len(runs) == 1)
            )
        plots = Section(title="Plots", plots=tuple(figures))
        if len(names) < 3:
            title = " and ".join(names)
        else:
            title = f"{len(names)} runs: {', '.join(names)}"
        files = {"overlay of all runs (PNG)": OVERVIEW_FILE, "table (Markdown)": TABLE_FILE}
        files = {label: name for label, name in files.items() if (partial / name).exists()}
        notes = (*notes, *([warning] if courses > 1 else []))
        verdict = conclusion(runs, names)
        page = render_page(
            "comparison", title, [plots], verdict=verdict, notes=notes, runs=views, rows=rows, files=files
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


def _place(run: FlightRecord, name: str, folder: str, colour: str, page_directory: Path) -> RunView:
    """Copy what a run has to offer beside the page."""
    place = page_directory / folder
    place.mkdir()
    source = run.directory
    files: dict[str, str] = {}
    video = poster = None
    if source is not None:
        files = _copied(source, place, folder)
    if source is not None and (source / VIDEO_FILE).is_file():
        from quadsim.report.film.video import write_poster

        video = f"{folder}.mp4"
        shutil.copyfile(source / VIDEO_FILE, page_directory / video)
        if write_poster(page_directory / video, page_directory / f"{folder}.jpg"):
            poster = f"{folder}.jpg"
        else:
            poster = None
    vehicle = f"Vehicle: {run.actual.description or run.actual.name}"
    return RunView(
        name=name,
        colour=colour,
        description=run.numbers.get("description", ""),
        facts=(", modelled with ".join([vehicle, *mismatch(run)]), _made_with(run)),
        video=video,
        length=run.end,
        poster=poster,
        files=files,
    )


def _copied(source: Path, place: Path, folder: str) -> dict[str, str]:
    """Copy the files and figures of a run directory; return the link to each by what it is."""
    files = {}
    for file, label in _FILES.items():
        if (source / file).is_file():
            shutil.copyfile(source / file, place / file)
            files[label] = quote(f"{folder}/{file}")
    if (source / FIGURES_DIR).is_dir():
        shutil.copytree(source / FIGURES_DIR, place / FIGURES_DIR)
        for path in sorted((place / FIGURES_DIR).glob("*.png")):
            files[f"figure: {path.stem}"] = quote(f"{folder}/{FIGURES_DIR}/{path.name}")
    return files


def _made_with(run: FlightRecord) -> str:
    """Versions and machine: what timings, and the last digits, depend on."""
    versions = run.numbers.get("versions", {})
    machine = run.numbers.get("machine", {})
    packages = [f"{name} {versions[name]}" for name in ("quadsim", "mujoco", "piqp") if name in versions]
    if {"processor", "cores"} <= machine.keys():
        where = f"{machine['processor']}, {machine['cores']} cores"
    else:
        where = ""
    return " on ".join(filter(None, (", ".join(packages), where)))
