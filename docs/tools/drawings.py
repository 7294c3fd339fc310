"""Drawings of the pages, made from the code that they explain: `python docs/tools/drawings.py` writes docs/assets."""

from __future__ import annotations

import math
import re
from pathlib import Path

from quadsim import load_vehicle
from quadsim.palette import CYCLE

ASSETS = Path(__file__).resolve().parents[1] / "assets"
INK, SOFT = "#6b7280", "#7c8596"
FORWARD, TURN = CYCLE[2:4]
STYLE = "font: 13px sans-serif; fill: " + SOFT


def svg(width: int, height: int, parts: list[str], *, arrows: bool = True) -> str:
    """An image of these parts that has no background, for light and dark pages."""
    marker = "".join(
        f'<marker id="{name}" viewBox="0 0 8 8" refX="6" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        f'<path d="M0 0 8 4 0 8z" fill="{colour}"/></marker>'
        for name, colour in (("forward", FORWARD), ("turn", TURN))
    )
    lines = "\n".join(parts)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}">\n'
        f"{f'<defs>{marker}</defs>' if arrows else ''}\n{lines}\n</svg>\n"
    )


def text(x: float, y: float, words: str, anchor: str = "middle", colour: str = SOFT) -> str:
    """Words at a point."""
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" style="{STYLE}; fill: {colour}">{words}</text>'


def arrow(x1: float, y1: float, x2: float, y2: float, kind: str = "forward") -> str:
    """A straight arrow."""
    colour = {"forward": FORWARD, "turn": TURN}[kind]
    ends = f'x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"'
    return f'<line {ends} stroke="{colour}" stroke-width="2" marker-end="url(#{kind})"/>'


def beam(x1: float, y1: float, x2: float, y2: float) -> str:
    """An arm of a vehicle, or all of it from the side."""
    ends = f'x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"'
    return f'<line {ends} stroke="{INK}" stroke-width="4" opacity=".6"/>'


def from_above(vehicle_name: str, cx: float, cy: float) -> list[str]:
    """A vehicle from above, x up the page: rotors with their numbers and the sense in which they turn."""
    vehicle = load_vehicle(vehicle_name)
    parts = [arrow(cx, cy, cx, cy - 52), text(cx + 12, cy - 40, "x", colour=FORWARD)]
    parts += [arrow(cx, cy, cx - 52, cy), text(cx - 42, cy - 8, "y", colour=FORWARD)]
    for i, (angle, spin) in enumerate(zip(vehicle.azimuths, vehicle.rotor_spins, strict=True), 1):
        x, y = cx - 95 * math.sin(angle), cy - 95 * math.cos(angle)
        parts.append(beam(cx, cy, x, y))
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="34" fill="none" stroke="{INK}" stroke-width="2"/>')
        # A reaction torque about +z is that of a rotor which turns clockwise, seen from above.
        sweep, (start, end) = (1, (-1, 1)) if spin > 0 else (0, (1, -1))
        at = 24 * math.cos(math.radians(35)), 24 * math.sin(math.radians(35))
        arc = f"M{x + start * at[0]:.1f} {y - at[1]:.1f} A24 24 0 0 {sweep} {x + end * at[0]:.1f} {y - at[1]:.1f}"
        parts.append(f'<path d="{arc}" fill="none" stroke="{TURN}" stroke-width="2" marker-end="url(#turn)"/>')
        parts.append(text(x + 11, y + 25, f"{i}", colour=INK))
    return [*parts, text(cx, cy + 160, f"{vehicle.name}, from above")]


def tilted(cx: float, cy: float, title: str, towards: str, side: int) -> list[str]:
    """A vehicle from the side, tilted by a positive angle towards one side of the page."""
    angle = math.radians(18) * side
    dx, dy = 80 * math.cos(angle), 80 * math.sin(angle)
    up = 70 * math.sin(angle), -70 * math.cos(angle)
    return [
        beam(cx - dx, cy - dy, cx + dx, cy + dy),
        arrow(cx, cy, cx + up[0], cy + up[1], "turn"),
        text(cx + up[0] * 1.2, cy + up[1] * 1.2, "thrust", colour=TURN),
        arrow(cx + 40 * side, cy + 55, cx + 100 * side, cy + 55),
        text(cx + 70 * side, cy + 75, towards, colour=FORWARD),
        text(cx, cy + 96, title),
    ]


def frames() -> str:
    """Body axes, rotor numbers and spins, and what a positive roll and pitch do."""
    parts = [*from_above("lopes2011", 160, 160), *from_above("crazyflie2", 460, 160)]
    parts += tilted(740, 95, "pitch above 0, from the right", "+x, forward", 1)
    parts += tilted(740, 295, "roll above 0, from behind", "-y, to the right", 1)
    return svg(880, 415, parts)


def floors() -> str:
    """The floors of quadsim in docs/architecture.md, each above those that it imports, and the data beside them."""
    page = (ASSETS.parent / "architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (`.*`|`.*) \| ([^:;|]*).*\|$", page.partition("## Floors")[2], re.MULTILINE)
    height, left, width = 34, 30, 570
    parts = []
    for i, (folders, has) in enumerate(rows):
        y = 10 + i * (height + 6)
        parts.append(box(left, y, width, height, FORWARD if i == 0 else INK))
        parts.append(text(left + 12, y + 22, folders.replace("`", ""), "start", FORWARD))
        parts.append(text(left + 150, y + 22, has.strip(" |"), "start"))
    bottom = 10 + len(rows) * (height + 6)
    parts.append(arrow(14, 14, 14, bottom - 8))
    parts.append(f'<g transform="rotate(-90 8 {bottom / 2:.1f})">{text(8, bottom / 2 + 1, "imports")}</g>')
    for i, (folder, has) in enumerate((("scenarios/", "files that you edit"), ("models/", "vehicles, MJCF"))):
        y = 10 + (4 + 5 * i) * (height + 6)
        parts.append(box(left + width + 50, y, 190, 2 * height + 6, TURN))
        parts.append(text(left + width + 145, y + 32, folder, colour=TURN))
        parts.append(text(left + width + 145, y + 54, has))
        parts.append(arrow(left + width + 48, y + height, left + width + 6, y + height, "turn"))
    return svg(850, bottom, parts)


def box(x: float, y: float, width: float, height: float, colour: str) -> str:
    """A frame."""
    size = f'x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}" rx="4"'
    return f'<rect {size} fill="none" stroke="{colour}" stroke-width="1.5"/>'


DRAWINGS = {"frames.svg": frames, "floors.svg": floors}

if __name__ == "__main__":
    for name, draw in DRAWINGS.items():
        (ASSETS / name).write_text(draw(), encoding="utf-8")
