"""The panel's texts as HTML: the state of the flight, its numbers, one row per constraint, and hints over the scene."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from html import escape
from typing import Final

from quadsim.controller import OPTIMAL, Command
from quadsim.features.live.session import Frame
from quadsim.flight.audit import Limit
from quadsim.palette import COLOUR, line_colour
from quadsim.report.table import signed_number

NEAR: Final = 0.1  # share of a bound's half band within which the row is marked
_FULL_BAR: Final = 1.2  # shares of a bound that a whole bar stands for: what is beyond the bound shows too
HINTS: Final = {
    "pull": "<b>Drag the drone</b> to pull it",
    "waypoint": '<b><span class="mouse">Shift-click</span><span class="touch">Tap</span> the floor</b> to fly there',
    "break": "<b>Break a rotor</b> with the button in the panel",
}

NOT_DRIVING: Final = ("You watch", "Another page has the controls: Take the controls changes that.")
"""Title and text of what a watcher is told who changes something."""
WATCH: Final = (
    "<style>.mantine-Button-root:not([style*=orange]),.mantine-Slider-root,.mantine-Input-wrapper{opacity:.45}</style>"
    '<div class="q"><div class="watch">You watch; another page has the controls.</div></div>'
)
OUTPUT: Final = (
    "Save: the run directory, with tables, figures and a recording. Scenario: a file that flies this session again, "
    "bit for bit. Replay: an HTML page that plays the scene."
)
STEER: Final = (
    "Type a set-point, drag its arrows, or "
    '<span class="touch">tap the floor.</span><span class="mouse">shift-click the floor. '
    "Keys W, S, A, D, R, F fly the set-point along x, y and z; X stops it.</span> So do the sticks of a gamepad: the "
    "left one x and y, the right one z."
)

FURTHER: Final = "further"  # class of a plot's curves that have no entry in its legend
READOUT_STYLE: Final = f"""<style>
.q{{font:12px/1.5 system-ui,sans-serif;padding:0 .8em}}.q b,.q .n{{font-variant-numeric:tabular-nums}}
.q .line{{height:1.5em;white-space:nowrap;overflow:hidden;text-overflow:ellipsis}}
.chip{{display:inline-block;padding:0 .6em;border-radius:1em;color:#fff;background:#6b7280;font-weight:600}}
.chip.flying{{background:{COLOUR.flown}}}.chip.ended{{background:{COLOUR.violated}}}
.q table{{width:100%;border-collapse:collapse;table-layout:fixed}}.q tr{{height:1.6em}}
.q td,.q th{{padding:0 4px 0 0;white-space:nowrap;overflow:hidden;text-overflow:ellipsis}}
.q th{{text-align:left;font-weight:400;opacity:.7}}.q .n{{text-align:right}}
.q .track{{position:relative;height:9px;background:#8884;border-radius:3px;overflow:hidden}}
.q .track i{{position:absolute;top:0;bottom:0}}
.q .bad{{color:{COLOUR.violated};font-weight:600}}.q .near{{font-weight:600}}.q .off{{opacity:.55}}
.q .watch{{background:#6b7280;color:#fff;padding:.4em .7em;border-radius:4px;margin:.4em 0}}
.q .why{{opacity:.75;padding-bottom:.5em}}
.hints,.over{{position:fixed;left:16px;z-index:5;pointer-events:none;font:14px/1.4 system-ui,sans-serif}}
.hints{{bottom:16px}}.over{{top:16px}}.hints .key{{font-size:12px}}
.hints div{{margin-top:6px;padding:4px 12px;border-radius:1em;background:#1f2937d9;color:#fff;width:max-content;
 max-width:calc(100vw - 400px)}}
.u-legend .{FURTHER}{{display:none}}.mantine-Slider-markLabel{{padding-top:3px}}
.touch{{display:none}}
@media (pointer:coarse){{.touch{{display:inline}}.mouse{{display:none}}.mantine-Button-root{{min-height:36px}}}}
@media (max-width:36em){{
 .hints{{top:8px;bottom:auto;font-size:12px}}
 .hints div{{max-width:none;margin-top:4px;padding:2px 10px}}.hints .key{{display:none}}
 .mantine-Paper-root[style*="20em"],.mantine-Paper-root [style*="20em"]{{width:100%!important}}
}}
</style>"""


def block(content: str, mark: str = "") -> str:
    """Return HTML in the panel's style."""
    return f'<div class="q"><div class="{mark}">{content}</div></div>'


def says(text: str, mark: str = "") -> str:
    """Return a sentence in the panel's style."""
    if text:
        return block(escape(text), mark)
    return ""


def hints(used: Collection[str], names: Sequence[str]) -> str:
    """Return the hints over the scene that have not been used, and the key to its colours."""
    left = [f"<div>{text}</div>" for name, text in HINTS.items() if name not in used]
    if len(names) > 1:
        vehicles = [f"{_dot(i)}{escape(name)}" for i, name in enumerate(names)]
        key = "; ".join([*vehicles, "inputs act on both"])
    else:
        key = "; ".join([*map(_named, ("flown", "predicted", "reference")), "arrows: thrusts", "orange arm: front"])
    return f'<div class="hints">{"".join(left)}<div class="key">octahedron: set-point; {key}</div></div>'


def status_line(state: str, frame: Frame | None, factor: float) -> str:
    """Return what the flight does now, its time and its speed; other than flying also where the panel is scrolled."""
    chip = f'<span class="chip {state}">{state}</span>'
    text = chip
    if frame is not None:
        text += f" <b>{frame.time:.2f} s</b>"
    if state != "flying":
        return block(text, "line") + f'<div class="over">{chip}</div>'
    if frame is not None:
        text += f", real-time factor {factor:.2f}"
    return block(text, "line")


def readings(frame: Frame | None, states: Sequence[tuple[float, float]] = (), lost: Collection[str] = ()) -> str:
    """Return the answer of the first vehicle's controller, the `states` of the vehicles, and why the other was lost.

    A state is tilt [deg] and position error [m].
    """
    if frame is None or frame.samples[0] is None:
        return block("&nbsp;", "line") * 4
    sample = frame.samples[0]
    solved = f"solved in <b>{1e3 * sample.step_s:.1f}</b> ms"
    if sample.missed:
        solved += f" {_bad('late')}"
    solved += f"; pull <b>{math.hypot(*frame.pull):.1f}</b> N"
    for rotor, share in enumerate(frame.health, 1):
        if share < 1.0:
            solved += f"; {_bad(f'rotor {rotor}: {100 * (share - 1):.0f} %')}"
    tilts = [f"{tilt:.1f}" for tilt, _ in states]
    errors = [f"{error:.2f}" for _, error in states]
    rows = [
        f"MPC: {_answer(sample.command)}",
        solved,
        f"tilt {_by_vehicle(tilts)} deg",
        f"position error {_by_vehicle(errors)} m",
    ]
    rows += [_bad(escape(reason)) for reason in lost]
    return "".join(block(row, "line") for row in rows)


def _answer(command: Command) -> str:
    """Return what the controller answered."""
    if command.status not in OPTIMAL or command.fallback:
        answer = _bad(f"QP {escape(command.status)}, fallback {command.fallback}")
    elif command.stats.active:
        answer = f"QP {escape(command.status)} by {escape(command.answered_by)}"
    else:
        answer = f"no bound active, by {escape(command.answered_by)}"
    if command.stats.active:
        answer += f", {command.stats.active} bounds active"
    return answer


def _bad(text: str) -> str:
    return f'<span class="bad">{text}</span>'


def _by_vehicle(values: Sequence[str]) -> str:
    """Return a value of each vehicle, of several behind a dot in its colour."""
    if len(values) == 1:
        return f"<b>{values[0]}</b>"
    return " ".join(f"{_dot(i)}<b>{value}</b>" for i, value in enumerate(values))


def _named(meaning: str) -> str:
    """Return the meaning of a colour of the palette, behind a dot in it."""
    return f'<span style="color:{getattr(COLOUR, meaning)}">●</span> {meaning}'


def _dot(vehicle: int) -> str:
    return f'<span style="color:{line_colour(vehicle)}">●</span> '


class Constraints:
    """A row per limit of the flight's start: the share of its bound that each vehicle uses, and margins."""

    def __init__(self, limits: tuple[Limit, ...]) -> None:
        self._limits = limits
        self.reset()

    def reset(self) -> None:
        """Forget the worst margins."""
        self._worst: dict[tuple[str, int], float] = {}

    def add(self, frame: Frame) -> None:
        """Take a period's margins into account."""
        for i, margins in enumerate(frame.margins):
            for name, margin in margins.items():
                if not math.isnan(margin):
                    self._worst[name, i] = min(margin, self._worst.get((name, i), math.inf))

    def rows(self, frame: Frame, audited: Collection[str]) -> str:
        """Return the table; `audited` names the limits that still apply."""
        if not self._limits:
            return ""
        titles = ["margin", "worst"]
        if len(frame.margins) > 1:
            titles = [f"{_dot(0)}worst", f"{_dot(1)}worst"]
        table = '<tr><th style="width:30%">constraint<th>utilisation'
        for title in titles:
            table += f'<th class="n" style="width:22%">{title}'
        for limit in self._limits:
            table += self._row(limit, limit.name in audited, frame)
        return block(f"<table>{table}</table>")

    def _row(self, limit: Limit, audited: bool, frame: Frame) -> str:
        margins = [margins_by_name.get(limit.name, math.nan) for margins_by_name in frame.margins]
        worst = [self._worst.get((limit.name, i), math.nan) for i in range(len(margins))]
        cells = [_number(limit, margin) for margin in worst]
        if len(margins) == 1:
            cells.insert(0, _number(limit, margins[0]))
        kind = ""
        if math.isnan(margins[0]):
            kind = "off"
            if audited and frame.time < limit.start:
                cells[0] = f"from {limit.start:g} s"
            else:
                cells[0] = "ended"
        elif margins[0] <= NEAR * limit.half_band:
            kind = "near"
        track = ""
        for i, margin in enumerate(margins):
            if not math.isnan(margin):
                track += _mark(limit, margin, i)
        track += f'<i style="left:{100.0 / _FULL_BAR:.1f}%;width:2px;background:{COLOUR.bound}"></i>'
        name = f"{escape(limit.name)} [{escape(limit.unit)}]"
        row = f'<tr class="{kind}"><td title="{name}">{name}</td><td><div class="track">{track}</div></td>'
        for cell in cells:
            row += f'<td class="n">{cell}</td>'
        return f"{row}</tr>"


def _number(limit: Limit, margin: float) -> str:
    """Return a margin, red where it is a violation."""
    if math.isnan(margin):
        return ""
    decimals = max(0, 2 - math.floor(math.log10(limit.half_band)))
    text = signed_number(margin, decimals)
    if limit.violated(margin):
        return f'<span class="bad" title="violated">{text}</span>'
    return text


def _mark(limit: Limit, margin: float, vehicle: int) -> str:
    """Return a vehicle's mark: the first one's bar grows towards the bound, the other's is a stroke at its end."""
    share = min(max(1.0 - margin / limit.half_band, 0.0), _FULL_BAR) / _FULL_BAR
    colour = line_colour(vehicle)
    if vehicle:
        return f'<i style="left:calc({100.0 * share:.1f}% - 2px);width:4px;background:{colour};z-index:1"></i>'
    if limit.violated(margin):
        colour = COLOUR.violated
    return f'<i style="left:0;width:{100.0 * share:.1f}%;background:{colour}"></i>'
