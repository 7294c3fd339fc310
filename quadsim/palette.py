"""The palette: one colour per meaning, in films, recordings, live sessions, figures, pages and the documentation.

The base is Okabe and Ito's palette for colour-blind readers (2008), its blue lightened for dark pages and its vermilion
turned to red.  Each colour is seen on white and on black; where the background is known, `on_light` and `on_dark` give
the same hue more contrast, for text above all.
"""

from __future__ import annotations

from typing import Final, NamedTuple

Rgb = tuple[int, int, int]


class Palette(NamedTuple):
    """The meanings, each with its colour."""

    flown: str = "#1b7fc4"  # what the vehicle does; the only flight, or the first of several
    second: str = "#cc79a7"  # the second vehicle or flight
    reference: str = "#e69f00"  # what it is to do: reference, set-point, commanded value
    predicted: str = "#009e73"  # what the controller expects
    measured: str = "#7a7f87"  # what sensors say; numbers that do not count
    bound: str = "#dc2f38"  # bounds, deadlines, edges of regions
    violated: str = "#dc2f38"  # whatever is beyond its bound, or failed: a bound's colour, as an area or a text
    satisfied: str = "#1b7fc4"  # whatever is within its bounds keeps the colour of what is flown
    warning: str = "#b39800"  # at a bound; beyond one that is not required; not reached
    lost: str = "#ad3a95"  # the vehicle
    disturbance: str = "#56b4e9"  # wind, external forces, pulls
    obstacle: str = "#b85c48"
    axis_x: str = "#d95f5f"  # of the world, by the convention of 3-D viewers
    axis_y: str = "#4fae62"
    axis_z: str = "#5a8cfa"


COLOUR: Final = Palette()
CYCLE: Final = (COLOUR.flown, COLOUR.second, "#8c6d31", "#5d4a8a", "#6e8b00", "#4d4f57")
"""Of several flights, rotors or components, which only a legend can name; none of them means anything else."""
# share in a colour that suits a dark, or as a text a light background
_WHITE = 0.2
_BLACK = 0.3


def line_colour(i: int) -> str:
    """Colour of the i-th flight, rotor or component, counted from 0; they repeat after six."""
    return CYCLE[i % len(CYCLE)]


def rgba(colour: str, opacity: float = 1.0) -> tuple[float, float, float, float]:
    """Red, green and blue of `#rrggbb`, and the opacity, 0 to 1."""
    red, green, blue = rgb(colour)
    return red / 255.0, green / 255.0, blue / 255.0, opacity


def rgb(colour: str) -> Rgb:
    """Red, green and blue of `#rrggbb`, 0 to 255."""
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return red, green, blue


def on_dark(colour: str) -> str:
    """The colour for a dark background, lightened."""
    return _mixed(colour, 255, _WHITE)


def on_light(colour: str) -> str:
    """The colour for text on a light background, darkened."""
    return _mixed(colour, 0, _BLACK)


def _mixed(colour: str, other: int, share: float) -> str:
    mixed = "#"
    for shade in rgb(colour):
        part = round((1.0 - share) * shade + share * other)
        mixed += f"{part:02x}"
    return mixed


ON_DARK: Final = Palette(*map(on_dark, COLOUR))
ON_LIGHT: Final = Palette(*map(on_light, COLOUR))


def _properties(palette: Palette, end: str = "") -> str:
    """Return a palette's custom properties, their names with an end."""
    text = ""
    for name, colour in palette._asdict().items():
        text += f" --{name.replace('_', '-')}{end}: {colour};"
    return text


def css() -> str:
    """The palette as custom properties: `--bound` for lines and areas, `--bound-text` for text in the page's theme."""
    lines = _properties(COLOUR)
    light = _properties(ON_LIGHT, "-text")
    dark = _properties(ON_DARK, "-text")
    return f":root {{{lines}{light} }}\n@media (prefers-color-scheme: dark) {{ :root {{{dark} }} }}"
