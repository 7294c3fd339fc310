"""Figures 2 to 5 of the paper from our flights, for docs/paper.md: part of `make numbers OPTIONS=pictures`."""

from __future__ import annotations

import io
import re
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl

import quadsim
from quadsim.report import flight_figures as figures
from quadsim.report.figure import Figure
from quadsim.report.to_matplotlib import STYLE, draw

ASSETS: Final = Path(__file__).resolve().parents[1] / "assets" / "figures"
WIDTH: Final = 6.4  # [in]
TEXT, GRID = "#3a4152", "#3a415226"
LOOKS: Final[dict[str, Any]] = {
    **{"axes.edgecolor": TEXT, "axes.labelcolor": TEXT, "text.color": TEXT, "grid.color": GRID},
    **dict.fromkeys(("xtick.color", "xtick.labelcolor", "ytick.color", "ytick.labelcolor"), TEXT),
    **{"svg.hashsalt": "quadsim", "svg.fonttype": "none", "font.family": "sans-serif", "path.simplify_threshold": 0.5},
}
"""Colours that show on light and on dark pages, and text as text."""


def to_svg(figure: Figure) -> str:
    """A figure without a background, coordinates to a tenth of a point."""
    file = io.StringIO()
    with mpl.rc_context(LOOKS):
        canvas = draw(figure)
        width, height = canvas.get_size_inches()
        canvas.set_size_inches(WIDTH, height * (WIDTH / width) ** 0.5)  # narrow, to be read on a phone as well
        canvas.savefig(file, format="svg", metadata={"Date": None}, transparent=True)
    return re.sub(r'="[^"]*"', lambda value: re.sub(r"(\d\.\d)\d+", r"\1", value[0]), file.getvalue())


def main() -> None:
    """Fly, and draw."""
    STYLE.update(LOOKS)
    for name, (states, inputs) in figures.PAPER_FIGURES.items():
        run = quadsim.fly(name, progress=False).run
        for key, figure in ((states, figures.states([run])), (inputs, figures.inputs([run]))):
            (ASSETS / f"{key.rstrip('_')}.svg").write_text(to_svg(replace(figure, title="")), encoding="utf-8")


if __name__ == "__main__":
    main()
