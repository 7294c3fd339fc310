"""Drawings of the pages, made from the code that they explain: `python docs/tools/drawings.py` writes docs/assets."""

from __future__ import annotations

import math
from pathlib import Path
from pkgutil import resolve_name

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
        for name, colour in (("forward", FORWARD), ("turn", TURN), ("soft", SOFT), ("ink", INK))
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
    colour = {"forward": FORWARD, "turn": TURN, "soft": SOFT, "ink": INK}[kind]
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


def box(x: float, y: float, width: float, title: str, name: str) -> list[str]:
    """A part: its title, and below it the class or function in the code, which has to exist."""
    resolve_name(name)
    module, _, member = name.partition(":")
    rest = f"{module}" if member == title else f"{module}.{member}"
    edge = f'x="{x}" y="{y}" width="{width}" height="54" rx="6" fill="none" stroke="{INK}" stroke-width="2"'
    small = (
        f'<text x="{x + width / 2}" y="{y + 42}" text-anchor="middle" style="{STYLE}; font-size: 11px">{rest}</text>'
    )
    heading = text(x + width / 2, y + 23, f'<tspan font-weight="bold">{title}</tspan>', colour=INK)
    return [f"<rect {edge}/>", heading, small]


def architecture() -> str:
    """One flight, from the file to the files."""
    left, right, wide = 30, 380, 260
    parts = [text(left + wide / 2, 22, "scenario file (TOML), --set")]
    parts += [arrow(left + wide / 2, 30, left + wide / 2, 48, "soft")]
    chain = (("Scenario", "scenarios.schema.scenario:Scenario"), ("Assembly", "scenarios.assembly:Assembly"))
    for j, (title, name) in enumerate(chain):
        parts += box(left, 50 + 90 * j, wide, title, name)
        parts.append(arrow(left + wide / 2, 106 + 90 * j, left + wide / 2, 138 + 90 * j, "soft"))
    parts += [
        text(left + wide / 2 + 10, 126, "checked, frozen", "start"),
        text(left + wide / 2 + 10, 216, "every part, built once", "start"),
    ]
    frame = 'x="10" y="230" width="660" height="330" rx="10" fill="none" stroke-width="1.5" stroke-dasharray="6 4"'
    parts.append(f'<rect {frame} stroke="{SOFT}"/>')
    parts.append(text(left, 258, '<tspan font-weight="bold">Rollout</tspan>', "start", INK))
    resolve_name("scenarios.rollout:Rollout")
    parts.append(text(left + 64, 258, "scenarios.rollout: one pass per control period", "start"))
    loop = (
        (left, 280, "Plant", "quadsim.sim.plant:Plant"),
        (left, 480, "Estimator", "quadsim.sim.navigation:Navigation"),
        (right, 480, "Controller", "mpc.linear:LinearMPC"),
        (right, 380, "QP", "mpc.solvers.piqp:Piqp"),
        (right, 280, "Fallback", "mpc.fallback.contract:Guard"),
    )
    for x, y, title, name in loop:
        parts += box(x, y, wide, title, name)
    middle, other = left + wide / 2, right + wide / 2
    parts += [arrow(middle, 336, middle, 478, "turn"), text(middle + 10, 410, "sensors", "start", TURN)]
    parts += [arrow(left + wide, 507, right - 2, 507, "turn"), text(335, 499, "state", colour=TURN)]
    parts += [arrow(other, 478, other, 436, "turn"), text(other + 10, 461, "H, f, bounds", "start", TURN)]
    parts += [arrow(other, 378, other, 336, "turn"), text(other + 10, 361, "answer, checked", "start", TURN)]
    parts += [arrow(right, 307, left + wide + 2, 307, "turn"), text(335, 299, "command", colour=TURN)]
    parts.append(arrow(middle, 562, middle, 588, "soft"))
    parts += box(left, 590, wide, "Flight", "scenarios.flown:Flight")
    parts += [arrow(left + wide, 617, right - 2, 617, "soft")]
    parts += box(right, 590, wide, "Audit", "quadsim.flight.audit:audit")
    parts += [arrow(other, 646, other, 674, "soft"), arrow(middle, 646, middle, 674, "soft")]
    parts += box(left, 676, wide, "Tables", "quadsim.flight.parquet:write_log")
    parts += box(right, 676, wide, "Summary", "scenarios.flown:summarise")
    return svg(680, 745, parts)


DRAWINGS = {"frames.svg": frames, "architecture.svg": architecture}

if __name__ == "__main__":
    for name, draw in DRAWINGS.items():
        (ASSETS / name).write_text(draw(), encoding="utf-8")
