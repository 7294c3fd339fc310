"""Make docs/gallery.md, a picture and the numbers of every scenario that ships: `make docs`.

Flies every scenario; neither the page nor the figures are stored in the repository.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import get_args

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from remake import ROOT, TITLES, scenario_cells

import quadsim
from quadsim.errors import RenderingUnavailableError
from scenarios.flight import Flight
from scenarios.machine import usable_cores
from scenarios.schema.scenario import Group

DOCS = Path(__file__).resolve().parent
PAGE, FIGURES = DOCS / "gallery.md", DOCS / "gallery"
GOLDEN = json.loads((ROOT / "tests/golden/library.json").read_text(encoding="utf-8"))
SIDES = np.array([-1.0, 1.0])
FILMED = ("power-loop", "inverted-start", "window", "thrown-ball")
"""Scenarios whose films are on the page too, where films can be made."""
HEAD = """# Gallery

Every scenario that ships: its path (dashed: the reference), roll and pitch with their bounds, or the tilt where the
vehicle may turn upside down, the verdict, and the constraint that came nearest to its bound. `quadsim run NAME` flies
one, films it and writes its recording; `quadsim scenario NAME` prints its file. What the words mean:
[scenarios](scenarios.md).
"""


def draw(flight: Flight, file: Path) -> None:
    """The path in space, roll and pitch."""
    figure = Figure(figsize=(8.0, 2.9), layout="constrained")
    left, right = figure.add_gridspec(1, 2, width_ratios=(1.0, 1.5))
    space = figure.add_subplot(left, projection="3d")
    reference, state = flight.reference, flight.plant
    space.plot(reference["x"], reference["y"], reference["z"], color="0.5", linestyle="--", linewidth=0.9)
    space.plot(state["x"], state["y"], state["z"], color="C0", linewidth=1.1)
    paths = np.stack([np.concatenate([reference[axis], state[axis]]) for axis in "xyz"])
    middle, widest = 0.5 * (paths.min(axis=1) + paths.max(axis=1)), max(1.0, np.ptp(paths, axis=1).max())
    half = 0.5 * np.maximum(np.ptp(paths, axis=1), 0.25 * widest)
    space.set(xlim=middle[0] + SIDES * half[0], ylim=middle[1] + SIDES * half[1], zlim=middle[2] + SIDES * half[2])
    space.set_box_aspect(half)
    space.ticklabel_format(useOffset=False)
    space.tick_params(labelsize=6, pad=-2)
    space.locator_params(nbins=4)
    axes = figure.add_subplot(right)
    shown = {"roll": state["roll"], "pitch": state["pitch"]}
    if flight.log.plant.attitude is not None:  # may turn upside down
        shown = {"tilt": np.arccos(np.cos(state["roll"]) * np.cos(state["pitch"]))}
    for i, (name, angle) in enumerate(shown.items()):
        axes.plot(state["t"], np.degrees(angle), color=f"C{i}", linewidth=1.0, label=name)
    for limit in (finding.limit for finding in flight.audit if finding.limit.signal in shown):
        for bound in (bound for bound in (limit.lower, limit.upper) if np.isfinite(bound)):
            axes.hlines(bound, limit.start, min(limit.stop, state["t"][-1]), color="tab:red", linestyle=":")
    axes.legend(ncols=2, frameon=False, loc="lower left", bbox_to_anchor=(0.0, 1.0))
    axes.set(xlabel="time [s]", ylabel=f"{', '.join(shown)} [deg]")
    figure.savefig(file, format="svg", metadata={"Date": None})


def film(flight: Flight, file: Path) -> str:
    """The film of a flight as the page shows it; nothing where none can be made."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            run = flight.save(Path(folder) / "run", recording=False, figures=False)
        except RenderingUnavailableError:
            return ""
        shutil.copy(run / "flight.mp4", file)
    return f'<video controls muted loop preload="metadata" width="100%" src="gallery/{file.name}"></video>\n'


def entry(name: str) -> tuple[Group, str]:
    """Fly and draw a scenario; its group, and its section of the page."""
    flight = quadsim.fly(name, progress=False)
    draw(flight, FIGURES / f"{name}.svg")
    clip = film(flight, FIGURES / f"{name}.mp4") if name in FILMED else ""
    verdict, errors, nearest = scenario_cells(GOLDEN[name])
    numbers = f"**{verdict}**"
    if errors != "-":
        numbers += f" · RMS error x, y, z {errors} m · nearest to its bound: {nearest}"
    return flight.scenario.group, (
        f"### {name}\n\n{flight.scenario.description}.\n\n![Path and attitude of {name}](gallery/{name}.svg)\n\n"
        f"{numbers}\n{clip and chr(10) + clip}"
    )


def main() -> None:
    """Fly everything and write the page."""
    FIGURES.mkdir(exist_ok=True)
    mpl.rcParams |= {"svg.hashsalt": "quadsim", "font.size": 8.0, "axes.spines.top": False, "axes.spines.right": False}
    with ProcessPoolExecutor(usable_cores()) as pool:
        entries = list(pool.map(entry, quadsim.catalogue().scenarios))
    parts = [HEAD]
    for group in get_args(Group):
        members = [text for of, text in entries if of == group]
        if members:
            parts += [f"## {TITLES.get(group, group)}\n", *members]
    PAGE.write_text("\n".join(parts), encoding="utf-8")


if __name__ == "__main__":
    main()
