"""The panel's texts as HTML: the state of the flight, its numbers, one row per constraint, and hints over the scene."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from html import escape
from typing import Final

from quadsim.controller import OPTIMAL
from quadsim.flight.audit import Limit
from quadsim.report.figure import BOUND, line_colour
from quadsim.sim.physics import FlownPeriod
from scenarios.live.session import Frame

NEAR: Final = 0.1  # share of a bound's half band within which the row says so
_SHOWN: Final = 1.2  # bounds to the right end of a bar: what is beyond the bound shows too
HINTS: Final = {
    "pull": "<b>Drag the drone</b> to pull it",
    "waypoint": '<b><span class="mouse">Shift-click</span><span class="touch">Tap</span> the floor</b> to fly there',
    "break": "<b>Break a rotor</b> with the button in the panel",
}

WATCH: Final = "You watch; another page has the controls."
STEER: Final = (
    "Type a set-point, drag its arrows, or "
    '<span class="touch">tap the floor.</span><span class="mouse">shift-click the floor. '
    "Keys W, S, A, D, R, F fly the set-point along x, y and z; X stops it.</span>"
)

STYLE: Final = """<style>
.q{font:12px/1.5 system-ui,sans-serif;padding:0 .8em}.q b,.q .n{font-variant-numeric:tabular-nums}
.q .line{height:1.5em;white-space:nowrap;overflow:hidden;text-overflow:ellipsis}
.chip{display:inline-block;padding:0 .6em;border-radius:1em;color:#fff;background:#2f7d4f;font-weight:600}
.chip.paused{background:#6b7280}.chip.busy{background:#a85f00}.chip.ended{background:#dc2f38}
.q table{width:100%;border-collapse:collapse;table-layout:fixed}.q tr{height:1.6em}
.q td,.q th{padding:0 4px 0 0;white-space:nowrap;overflow:hidden;text-overflow:ellipsis}
.q th{text-align:left;font-weight:400;opacity:.65}.q .n{text-align:right;padding-right:8px}
.q .track{position:relative;height:9px;background:#8884;border-radius:3px;overflow:hidden}
.q .track i{position:absolute;top:0;bottom:0}
.q .bad{color:#dc2f38;font-weight:600}.q .near{font-weight:600}.q .off{opacity:.55}
.q .watch{background:#a85f00;color:#fff;padding:.4em .7em;border-radius:4px;margin:.4em 0;white-space:normal}
.q .why{opacity:.75;padding-bottom:.5em}
.hints,.over{position:fixed;left:16px;z-index:5;pointer-events:none;font:14px/1.4 system-ui,sans-serif}
.hints{bottom:16px}.over{top:16px}
.hints div{margin-top:6px;padding:4px 12px;border-radius:1em;background:#1f2937d9;color:#fff;width:max-content}
.touch{display:none}
@media (pointer:coarse){.touch{display:inline}.mouse{display:none}}
@media (max-width:36em){
 .hints{top:8px;bottom:auto;font-size:12px}.hints div{margin-top:4px;padding:2px 10px}
 .mantine-Paper-root[style*="20em"],.mantine-Paper-root [style*="20em"]{width:100%!important}
}
</style>"""


def block(content: str, mark: str = "") -> str:
    """Return HTML in the panel's style."""
    return f'<div class="q"><div class="{mark}">{content}</div></div>'


def says(text: str, mark: str = "") -> str:
    """Return a sentence in the panel's style."""
    return block(escape(text), mark) if text else ""


def hints(used: Collection[str]) -> str:
    """Return the hints over the scene that have not been used."""
    left = "".join(f"<div>{text}</div>" for name, text in HINTS.items() if name not in used)
    return f'<div class="hints">{left}</div>'


def headline(state: str, kind: str, frame: Frame | None, factor: float) -> str:
    """Return what the flight does now, its time and its speed."""
    time = "" if frame is None else f" <b>{frame.time:.2f} s</b>"
    speed = f", {factor:.2f} of real time" if frame is not None and kind == "flying" else ""
    chip = f'<span class="chip {kind}">{escape(state)}</span>'
    over = "" if kind == "flying" else f'<div class="over">{chip}</div>'  # seen also where the panel is scrolled
    return block(f"{chip}{time}{speed}", "line") + over


def numbers(
    frame: Frame | None,
    sample: FlownPeriod | None = None,
    *,
    tilt: float = 0.0,
    error: float = 0.0,
    lost: Collection[str] = (),
) -> str:
    """Return the answer of the controller and the state of the first vehicle, and why the other one was lost."""
    if frame is None or sample is None:
        return block("&nbsp;", "line") * 3
    command = sample.command
    answer = f"{escape(command.status)} ({escape(command.answered_by)})"
    if command.status not in OPTIMAL or command.fallback:
        answer = f'<span class="bad">{answer}, fallback {command.fallback}</span>'
    late = ' <span class="bad">late</span>' if sample.missed else ""
    rows = [
        f"MPC: {answer}, {command.active} bounds active",
        f"step <b>{1e3 * sample.step_s:.1f}</b> ms{late}, your pull <b>{math.hypot(*frame.pull):.1f}</b> N",
        f"tilt <b>{tilt:.1f}</b> deg, position error <b>{error:.2f}</b> m",
        *(f'<span class="bad">{escape(text)}</span>' for text in lost),
    ]
    return "".join(block(row, "line") for row in rows)


def legend(names: Iterable[str]) -> str:
    """Return which colour is whose, with two vehicles."""
    marks = [f'<b style="color:{line_colour(i)}">●</b> {escape(name)}' for i, name in enumerate(names)]
    return block(" &nbsp; ".join(marks), "line") if len(marks) > 1 else ""


def constraint_rows(limits: tuple[Limit, ...], audited: Collection[str], frame: Frame) -> str:
    """Return a row per limit: the share of its bound that each vehicle uses, and the margin of the first one.

    `limits` are those of the flight's start, `audited` names those that still apply.
    """
    head = (
        '<tr><th style="width:27%">constraint<th>bound used<th class="n" style="width:27%">margin<th style="width:17%">'
    )
    rows = [_row(limit, limit.name in audited, frame) for limit in limits]
    return block(f"<table>{head}{''.join(rows)}</table>") if rows else ""


def _row(limit: Limit, audited: bool, frame: Frame) -> str:
    margins = [margins.get(limit.name, math.nan) for margins in frame.margins]
    marks = "".join(_mark(limit, margin, i) for i, margin in enumerate(margins) if not math.isnan(margin))
    first, word, kind = margins[0], "", ""
    if math.isnan(first):
        kind = "off"
        number = f"from {limit.start:g} s" if audited and frame.time < limit.start else "ended"
    else:
        decimals = max(0, 2 - math.floor(math.log10(limit.half_band)))
        number = f"{round(first, decimals) + 0.0:+.{decimals}f} {limit.unit}"
        if is_violated(limit, first):
            word = kind = "bad"
            word = "violated"
        elif first <= NEAR * limit.half_band:
            word = kind = "near"
    bound = f'<i style="left:{100.0 / _SHOWN:.1f}%;width:2px;background:{BOUND}"></i>'
    return (
        f'<tr class="{kind}"><td title="{escape(limit.name)}">{escape(limit.name)}</td>'
        f'<td><div class="track">{marks}{bound}</div></td><td class="n">{escape(number)}</td><td>{word}</td></tr>'
    )


def is_violated(limit: Limit, margin: float) -> bool:
    """Return whether the audit would call a margin a violation; a solver's rounding is none."""
    return margin + limit.tolerance < -1e-9 * limit.half_band


def _mark(limit: Limit, margin: float, vehicle: int) -> str:
    """Return a vehicle's mark: the first one's bar grows towards the bound, the other's is a stroke at its end."""
    share = min(max(1.0 - margin / limit.half_band, 0.0), _SHOWN) / _SHOWN
    colour = BOUND if is_violated(limit, margin) else line_colour(vehicle)
    if vehicle == 0:
        return f'<i style="left:0;width:{100.0 * share:.1f}%;background:{colour}"></i>'
    return f'<i style="left:calc({100.0 * share:.1f}% - 2px);width:4px;background:{colour}"></i>'
