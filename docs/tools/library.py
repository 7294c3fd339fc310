"""The table and the films of docs/gallery.md, made from the library of scenarios as the site is built."""

from __future__ import annotations

from html import escape
from typing import Final

from quadsim.scenarios.catalogue import read_catalogue

PLACE: Final = "<!-- library: docs/tools/library.py -->"
TOPICS: Final = {
    "paper": "the paper",
    "papers": "other papers",
    "courses": "courses",
    "air": "wind, drag, lag",
    "faults": "faults",
    "ground": "ground",
    "space": "obstacles",
    "sensors": "sensors",
}
"""Of each group of scenarios, its name in the table."""
FILMS: Final = (
    *("paper-constrained-lag20", "robust-lag50", "power-loop", "window", "thrown-ball", "take-off-and-landing"),
)
"""The scenarios that the library films."""


def title(name: str) -> str:
    """A scenario's name, which opens its file."""
    return f'<a href="scenarios/{name}.txt"><code>{name}</code></a>'


def html() -> str:
    """Every scenario with its path, topic and verdict; films under posters, to which library.js gives controls."""
    shown = sorted(read_catalogue().scenarios.items(), key=lambda entry: [*TOPICS].index(entry[1].group))
    rows = [
        f'<tr><td><img alt="{name}" src="assets/gallery/{name}.svg"> {title(name)} '
        f"{escape(scenario.description)}</td><td>{TOPICS[scenario.group]}</td><td>{scenario.expect}</td></tr>"
        for name, scenario in shown
    ]
    films = [
        f'<figure><video src="films/{name}.mp4" poster="assets/gallery/{name}.jpg" preload="none"></video>'
        f"<figcaption>{title(name)}</figcaption></figure>"
        for name in FILMS
    ]
    head = "<thead><tr><th>scenario</th><th>topic</th><th>verdict</th></tr></thead>"
    table = f'<div class="library"><table>{head}<tbody>{"".join(rows)}</tbody></table></div>'
    return f'{table}<div class="films">{"".join(films)}</div>'
