"""One colour per meaning: the palette is the only source of colours, and everybody can tell them apart."""

from __future__ import annotations

import ast
import itertools
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from quadsim.palette import COLOUR, CYCLE, ON_DARK, ON_LIGHT, css, line_colour, on_dark, rgb, rgba

ROOT = Path(__file__).resolve().parents[1]
READ = (
    *("quadsim/**/*.py", "docs/tools/*.py", "docs/fly/*", "docs/assets/*.css"),
    *("quadsim/report/templates/*", "docs/assets/gallery/*.svg", "docs/assets/*.svg"),
)
GREYEST = 40
"""Ink, paper, floor and shade: a colour whose red, green and blue differ by no more than this has no meaning."""
MATERIALS = {
    ("quadsim/features/live/look.py", "#f56b14"): "icon: the vehicle's front, as in models/quadrotor.xml",
    ("quadsim/features/live/look.py", "#1b7fc4"): "icon",
    ("quadsim/features/live/look.py", "#839dc0"): "sky",
    ("quadsim/features/live/look.py", "#31435a"): "sky",
    ("quadsim/report/templates/page.css", "#0b5cad"): "link",
    ("quadsim/report/templates/page.css", "#7cb8ff"): "link",
    ("docs/tools/gallery.py", "(160, 90, 8)"): "no colour: lengths in pixels",
    ("quadsim/features/live/look.py", "(128, 128, 3)"): "no colour: shape of an array",
    ("docs/fly/fly.js", "#596b85"): "rotor disc, as in models/quadrotor.xml",
}
"""Colours of things, which say nothing of a flight, and what they are."""
DRAWING = ("quadsim/report", "quadsim/sim/airframe.py", "quadsim/features/live", "docs")
"""Where a tuple of numbers may be a colour."""
PAGE = "#ffffff"
DARK_PAGE = "#14171a"
BLINDNESS = {
    "none": np.eye(3),
    "protanopia": [[0.1523, 1.0526, -0.2049], [0.1145, 0.7863, 0.0992], [-0.0039, -0.0481, 1.0520]],
    "deuteranopia": [[0.3673, 0.8607, -0.2280], [0.2801, 0.6725, 0.0474], [-0.0118, 0.0429, 0.9689]],
}
"""What is seen of linear RGB: Machado, Oliveira and Fernandes (2009), severity 1."""
SHARED = ({"bound", "violated"}, {"flown", "satisfied"})
"""Meanings of one colour: red is a bound and what is beyond it, blue is what is flown and stays within."""
TOGETHER = (
    ("flown", "second", "reference", "violated"),
    ("flown", "predicted", "reference", "bound", "measured"),
    ("satisfied", "warning", "violated", "lost"),
)
"""What one picture shows."""


def linear(colour: str) -> np.ndarray:
    values = np.array(rgb(colour)) / 255.0
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def contrast(colour: str, other: str) -> float:
    """By WCAG 2."""
    low, high = sorted(float(linear(each) @ [0.2126, 0.7152, 0.0722]) for each in (colour, other))
    return (high + 0.05) / (low + 0.05)


def difference(colour: str, other: str, sight: str) -> float:
    """Of two colours in CIELAB, D65."""
    to_xyz = np.array([[0.4339, 0.3762, 0.1899], [0.2126, 0.7152, 0.0722], [0.0178, 0.1095, 0.8727]])
    lab = []
    for each in (colour, other):
        f = np.cbrt(np.maximum(to_xyz @ np.clip(np.asarray(BLINDNESS[sight]) @ linear(each), 0.0, 1.0), 1e-3))
        lab.append(np.array([116.0 * f[1] - 16.0, 500.0 * (f[0] - f[1]), 200.0 * (f[1] - f[2])]))
    return float(np.linalg.norm(lab[0] - lab[1]))


def is_coloured(channels: tuple[float, ...]) -> bool:
    return max(channels) - min(channels) > GREYEST


def literals(path: Path) -> Iterator[tuple[str, tuple[float, ...]]]:
    """The colours in a file, as `#rrggbb`: hexadecimal ones, and tuples of numbers where something is drawn."""
    text = path.read_text(encoding="utf-8")
    for digits in re.findall(r"(?:#|\b0x)([0-9a-fA-F]{8}|[0-9a-fA-F]{6}|[0-9a-fA-F]{3})\b", text):
        long = digits[:6] if len(digits) > 3 else "".join(2 * digit for digit in digits)
        yield f"#{long.lower()}", rgb(f"#{long}")
    for inside in re.findall(r"rgba?\(([\d\s.,]+)\)", text):
        channels = tuple(float(number) for number in inside.split(","))[:3]
        yield inside, channels
    if path.suffix == ".py" and path.relative_to(ROOT).as_posix().startswith(DRAWING):
        for node in ast.walk(ast.parse(text)):
            numbers = [part.value for part in getattr(node, "elts", ()) if isinstance(part, ast.Constant)]
            if len(numbers) != len(getattr(node, "elts", ())) or len(numbers) not in (3, 4):
                continue
            if all(isinstance(number, int) and 0 <= number <= 255 for number in numbers) and max(numbers) > 60:
                yield str(tuple(numbers)), tuple(map(float, numbers[:3]))
            elif len(numbers) == 4 and all(isinstance(number, float) and 0.0 <= number <= 1.0 for number in numbers):
                yield str(tuple(numbers)), tuple(255.0 * number for number in numbers[:3])


def files() -> list[Path]:
    return sorted(
        {path for pattern in READ for path in ROOT.glob(pattern) if path.is_file() and path.name != "palette.py"}
    )


def test_no_colour_with_a_meaning_stands_outside_the_palette() -> None:
    stored = {*COLOUR, *CYCLE}
    strangers = {
        (path.relative_to(ROOT).as_posix(), text)
        for path in files()
        for text, channels in literals(path)
        if is_coloured(channels) and not (path.suffix == ".svg" and text in stored)  # which a script has drawn
    }
    assert strangers - set(MATERIALS) == set()
    assert set(MATERIALS) - strangers == set(), "no longer there"


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("quadsim/report/a.py", "A = '#dc2f38'", ["#dc2f38"]),
        (
            "quadsim/report/a.py",
            "A = (255, 84, 66)\nB = (1.0, 0.2, 0.12, 0.95)\nC = (1, 0, 0)",
            ["(255, 84, 66)", None],
        ),
        ("docs/fly/fly.js", "new Color(active ? 0xe0402a : 0x596b85)", ["#e0402a", "#596b85"]),
        ("a.css", "p { color: #f00; background: rgb(10, 20, 200); margin: 12px }", ["#ff0000", "10, 20, 200"]),
    ],
)
def test_the_search_finds_each_way_of_writing_a_colour(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, text: str, expected: list[str | None]
) -> None:
    monkeypatch.setitem(globals(), "ROOT", tmp_path)
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).write_text(text)
    found = [literal for literal, channels in literals(tmp_path / name) if is_coloured(channels)]
    assert len(found) == len(expected)
    assert all(one is None or one in found for one in expected)


def test_each_colour_has_one_meaning() -> None:
    for (name, colour), (other, also) in itertools.combinations(COLOUR._asdict().items(), 2):
        assert (colour == also) == ({name, other} in SHARED), (name, other)
    assert CYCLE[:2] == (COLOUR.flown, COLOUR.second)
    assert not set(CYCLE[2:]) & set(COLOUR)
    assert len(set(CYCLE)) == len(CYCLE)
    assert line_colour(len(CYCLE) + 1) == COLOUR.second


@pytest.mark.parametrize("name", COLOUR._fields)
def test_each_colour_shows_on_light_and_on_dark_and_as_a_text(name: str) -> None:
    colour = getattr(COLOUR, name)
    assert min(contrast(colour, PAGE), contrast(colour, DARK_PAGE)) > 2.0
    assert contrast(getattr(ON_DARK, name), DARK_PAGE) > 4.5
    if name in ("satisfied", "warning", "violated"):  # which pages write
        assert contrast(getattr(ON_LIGHT, name), PAGE) > 4.5


@pytest.mark.parametrize("sight", BLINDNESS)
@pytest.mark.parametrize("names", TOGETHER, ids=" ".join)
def test_colours_of_one_picture_differ_for_colour_blind_readers(names: tuple[str, ...], sight: str) -> None:
    for name, other in itertools.combinations(names, 2):
        apart = difference(getattr(COLOUR, name), getattr(COLOUR, other), sight)
        assert apart > 14.0, (name, other)  # 2.3 is a just noticeable difference


def test_pages_get_every_meaning_in_both_themes() -> None:
    light, dark = css().split("@media (prefers-color-scheme: dark)")
    for name, colour in COLOUR._asdict().items():
        assert f"--{name.replace('_', '-')}: {colour};" in light
        assert f"--{name.replace('_', '-')}-text: {getattr(ON_LIGHT, name)};" in light
        assert f"--{name.replace('_', '-')}-text: {getattr(ON_DARK, name)};" in dark


def test_colours_convert() -> None:
    assert rgb("#ff8000") == (255, 128, 0)
    assert rgba("#ff0000", 0.5) == (1.0, 0.0, 0.0, 0.5)
    assert on_dark("#000000") == "#333333"
