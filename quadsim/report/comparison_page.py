"""Several runs -> one directory to open and share: an HTML page that works offline, beside its videos and files."""

from __future__ import annotations

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
from quadsim.report.comparison import conclusion, distinct_courses, run_names
from quadsim.report.comparison_rows import comparison_rows
from quadsim.report.figure import Scene
from quadsim.report.flight_figures import overview, page_figures
from quadsim.report.flight_sentences import with_mismatch
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
    _check_places(runs, directory)
    names = run_names(runs)
    rows = comparison_rows(runs)
    courses = len(distinct_courses(runs))
    if courses > 1:
        warning = f"The runs follow {courses} different courses, so their errors are not like for like."
        notes = (*notes, warning)
    with writing(directory, overwrite=overwrite) as partial:
        (partial / TABLE_FILE).write_text(to_markdown(rows, names), encoding="utf-8")
        with optional(OVERVIEW_FILE):
            write_pngs([overview(runs)], partial)
        views = []
        for i, (run, name, folder) in enumerate(zip(runs, names, _folder_names(names), strict=True)):
            views.append(_copy_run(run, name, folder, line_colour(i), partial))
        files = {"table (Markdown)": TABLE_FILE}
        if (partial / OVERVIEW_FILE).exists():
            files = {"overlay of all runs (PNG)": OVERVIEW_FILE, **files}
        page = render_page(
            "comparison",
            _title(names),
            [_plots(runs)],
            verdict=conclusion(runs, names),
            notes=notes,
            runs=views,
            rows=rows,
            files=files,
        )
        (partial / PAGE_FILE).write_text(page, encoding="utf-8")
    return directory / PAGE_FILE


def _check_places(runs: Sequence[FlightRecord], directory: Path) -> None:
    """Refuse runs whose directory cannot be copied from, or is inside the one to be written."""
    target = directory.resolve()
    for run in runs:
        if run.directory is None:
            continue
        require_inside(run.directory)  # copying follows links
        if run.directory.resolve().is_relative_to(target):
            raise OutputError(directory, f"it holds the run {run.directory}, which must stay; choose another --out")


def _plots(runs: Sequence[FlightRecord]) -> Section:
    """The figures; those of several runs are labelled by the toggles of the page."""
    plots = []
    for figure in page_figures(runs):
        if isinstance(figure, Scene):
            plots.append(scene_to_plot(figure))
        else:
            plots.append(to_plot(figure, labelled=len(runs) == 1))
    return Section(title="Plots", plots=tuple(plots))


def _title(names: Sequence[str]) -> str:
    if len(names) < 3:
        return " and ".join(names)
    return f"{len(names)} runs: {', '.join(names)}"


def _folder_names(names: Sequence[str]) -> list[str]:
    """A distinct name of plain characters for each run's files."""
    folders: list[str] = []
    for name in names:
        plain = re.sub(r"[^a-z0-9_-]+", "-", name.lower()).strip("-") or "run"
        folder = plain
        number = 1
        while folder in folders:
            number += 1
            folder = f"{plain}-{number}"
        folders.append(folder)
    return folders


def _copy_run(run: FlightRecord, name: str, folder: str, colour: str, page_directory: Path) -> RunView:
    """Copy what a run has to offer beside the page."""
    target = page_directory / folder
    target.mkdir()
    files: dict[str, str] = {}
    video = None
    poster = None
    if run.directory is not None:
        files = _copy_files(run.directory, target, folder)
        video, poster = _copy_video(run.directory, page_directory, folder)
    vehicle = f"Vehicle: {run.actual.description or run.actual.name}"
    return RunView(
        name=name,
        colour=colour,
        description=run.numbers.get("description", ""),
        facts=(with_mismatch(run, vehicle), _versions_and_machine(run)),
        video=video,
        length=run.end,
        poster=poster,
        files=files,
    )


def _copy_files(source: Path, place: Path, folder: str) -> dict[str, str]:
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


def _copy_video(source: Path, page_directory: Path, folder: str) -> tuple[str | None, str | None]:
    """Copy the video of a run directory, and make its poster; return the link to each, None without it."""
    if not (source / VIDEO_FILE).is_file():
        return None, None
    from quadsim.report.film.video import write_poster

    video = f"{folder}.mp4"
    poster = f"{folder}.jpg"
    shutil.copyfile(source / VIDEO_FILE, page_directory / video)
    if write_poster(page_directory / video, page_directory / poster):
        return video, poster
    return video, None


def _versions_and_machine(run: FlightRecord) -> str:
    """What timings, and the last digits, depend on."""
    versions = run.numbers.get("versions", {})
    machine = run.numbers.get("machine", {})
    packages = [f"{name} {versions[name]}" for name in ("quadsim", "mujoco", "piqp") if name in versions]
    parts = []
    if packages:
        parts.append(", ".join(packages))
    if {"processor", "cores"} <= machine.keys():
        parts.append(f"{machine['processor']}, {machine['cores']} cores")
    return " on ".join(parts)
