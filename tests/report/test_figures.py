"""Figures of flights: their data, units and bounds, and that both libraries draw what they describe."""

from __future__ import annotations

import dataclasses
import json
import os
import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
from matplotlib.image import imread
from support import judged_by, renamed, small_log

from quadsim.errors import ParameterError
from quadsim.flight.audit import SIGNALS, Limit, SpaceLimit
from quadsim.flight.log import FlightLog
from quadsim.palette import COLOUR
from quadsim.report import flight_figures
from quadsim.report.figure import (
    LEAST_SPANS,
    Band,
    Bound,
    Figure,
    Label,
    Panel,
    Series,
    break_at_wraps,
    commanded_speeds,
    effect_curves,
    least_range,
)
from quadsim.report.flight_figures import effects, inputs, overview, page_figures, states, times, write_figures
from quadsim.report.to_matplotlib import draw, figure_html, to_png
from quadsim.report.to_plotly import thinned_curve, to_plot
from quadsim.rollout.flown import Flight
from quadsim.space import Cylinder
from quadsim.state import INDEX, POSITION, Array

pytestmark = pytest.mark.slow("figures")


def panels(figure: Figure) -> dict[str, Panel]:
    return {panel.heading: panel for panel in figure.panels}


def curves(panel: Panel) -> dict[str, Series]:
    return {series.label: series for series in panel.series}


def with_effects(run: Flight) -> Flight:
    """The flight as if it had met with wrench, wind, lagging rotors and errors of measurement."""
    plant = run.log.plant
    control = run.log.control
    rng = np.random.default_rng(0)
    wrench = rng.normal(size=(plant.t.size, 6))
    wind = rng.normal(size=(plant.t.size, 3))
    plant = dataclasses.replace(plant, wrench=wrench, wind=wind, speeds=plant.speeds + 1.0)
    control = dataclasses.replace(control, state=control.state + 0.01)
    return dataclasses.replace(run, log=dataclasses.replace(run.log, plant=plant, control=control))


@pytest.mark.representative("figures")
def test_the_papers_scenario_gives_the_papers_figure_numbers(short_run: Flight, tmp_path: Path) -> None:
    paths = write_figures(short_run, tmp_path)
    assert [path.name for path in paths] == ["figure4_states.png", "figure5_inputs.png", "solve_times.png"]
    for path in paths:
        picture = imread(path)[..., :3]
        assert picture.shape[1] >= 1400
        assert 0.01 < np.mean(np.any(picture < 0.95, axis=-1)) < 0.5, "not blank"


def test_a_planar_course_is_drawn_from_above(short_run: Flight, tmp_path: Path) -> None:
    control = short_run.log.control
    angle = np.linspace(0.0, 2.0 * np.pi, control.t.size)
    reference = np.stack([2.0 * np.cos(angle), np.sin(angle), np.ones_like(angle), 0.0 * angle], axis=1)

    def flown(reference: Array) -> Flight:
        log = dataclasses.replace(short_run.log, control=dataclasses.replace(control, reference=reference))
        return dataclasses.replace(renamed(short_run, "circle"), log=log)

    run = flown(reference)
    assert write_figures(run, tmp_path)[-1].name == "xy.png"
    ((panel,),) = (figure.panels for figure in flight_figures.xy(run))
    drawn = curves(panel)
    position = run.log.plant.state[:, POSITION]
    assert panel.equal
    assert [*drawn] == ["reference, filtered", "flight", "start", "end"]
    assert np.array_equal(drawn["reference, filtered"].y, reference[:, 1])
    assert np.array_equal(drawn["flight"].x, position[:, 0])
    assert [drawn[name].x.tolist() for name in ("start", "end")] == [[position[0, 0]], [position[-1, 0]]]
    for moved in ([0.0, 0.0, 0.1, 0.0], [0.0, -1.0, 0.0, 0.0]):  # it climbs too; it moves along x alone
        assert flight_figures.xy(flown(reference + np.outer(np.sin(angle), moved))) == []


@pytest.mark.usefixtures("undrawn")
def test_another_scenario_gives_plain_names_and_its_effects(
    short_run: Flight, empty_run: Flight, tmp_path: Path
) -> None:
    run = with_effects(renamed(short_run, "hover"))
    assert [path.stem for path in write_figures(run, tmp_path)] == ["states", "inputs", "solve_times", "effects"]
    assert write_figures(empty_run, tmp_path) == page_figures([empty_run]) == [], "it has no control period"
    assert effects(short_run) == [], "an ideal flight"
    (figure,) = effects(run)
    assert list(panels(figure)) == [
        *(f"rotor {i} [rad/s]" for i in range(1, 5)),
        *("external force, world [N]", "external torque, body [N\u00a0m]", "wind, world [m/s]"),
        *("error of the measured position [m]", "error of the measured attitude [deg]"),
    ]
    measured = curves(panels(states([run]))["roll [deg]"])["measured"].y
    np.testing.assert_allclose(measured, np.degrees(run.log.control.state[:, INDEX["roll"]]))


def test_states_are_those_of_the_plant_with_units_references_and_bounds(short_run: Flight) -> None:
    result = panels(states([short_run]))
    assert list(result) == ["x [m]", "roll [deg]", "y [m]", "pitch [deg]", "z [m]", "yaw [deg]"]
    plant = short_run.log.plant
    control = short_run.log.control
    np.testing.assert_array_equal(curves(result["z [m]"])["flight"].y, plant.state[:, INDEX["z"]])
    np.testing.assert_allclose(curves(result["pitch [deg]"])["flight"].y, np.degrees(plant.state[:, INDEX["pitch"]]))
    np.testing.assert_array_equal(curves(result["z [m]"])["reference, filtered"].y, control.reference[:, 2])
    assert [(bound.value, bound.start, bound.stop) for bound in result["roll [deg]"].bounds] == [
        (-5.0, 0.0, short_run.end),
        (5.0, 0.0, short_run.end),
    ]
    assert "measured" not in states([short_run]).labels
    assert result["z [m]"].least_range is None, "it moves"
    assert times([short_run]).panels[0].bounds[0].value == 50.0, "the deadline"
    late = judged_by(short_run, Limit(name="late", signal="roll", upper=5.0, start=100.0))
    assert panels(states([late]))["roll [deg]"].bounds == (), "it begins after the flight"


def test_a_violated_bound_on_another_signal_has_a_panel(short_run: Flight) -> None:
    """The bounds on position and attitude are in their panels, and those on rotor speeds in `inputs`."""
    climb = Limit(name="climb", signal="climb_acceleration", lower=-0.01, upper=0.01)
    held = Limit(name="tilt", signal="tilt", upper=90.0)
    others = [Limit(name="x", signal="x", upper=-100.0), Limit(name="speed", signal="speed", upper=1.0)]
    run = judged_by(short_run, climb, held, *others)
    figure = states([run])
    *_, panel = figure.panels
    assert len(figure.panels) == 7
    assert panel.heading.startswith("climb_acceleration [m/s^2]")
    assert {bound.value for bound in panel.bounds} == {-0.01, 0.01}
    assert figure.title == "position, attitude and other violated signals"
    assert to_png(figure, dpi=30)
    assert to_plot(figure).json


def test_inputs_are_the_commands_of_each_rotor(short_run: Flight) -> None:
    speeds = short_run.log.control.speeds
    alone = curves(panels(inputs([short_run]))["rotor speed [rad/s]"])
    np.testing.assert_array_equal(alone["rotor 3"].y, speeds[:, 2])
    overlaid = panels(inputs([short_run, renamed(short_run, "other")]))["rotor speed, rotor 3 [rad/s]"]
    assert {label: series.group for label, series in curves(overlaid).items()} == {
        "paper-constrained": "run0",
        "other": "run1",
    }
    np.testing.assert_array_equal(curves(overlaid)["other"].y, speeds[:, 2])
    assert {bound.value for bound in overlaid.bounds} == {0.0, 250.0}


def test_a_comparison_names_every_run_and_shows_the_range_of_its_rotors(short_run: Flight) -> None:
    figure = overview([short_run, renamed(short_run, "other $x$ <b>")])
    assert to_png(figure, dpi=30) == to_png(figure, dpi=30)
    assert list(figure.labels) == ["reference, filtered", "paper-constrained", "other $x$ <b>"]
    (band, _) = figure.panels[-1].bands
    np.testing.assert_array_equal(band.high, short_run.log.control.speeds.max(axis=1))


@pytest.mark.parametrize("x_label", ["", "n"])
def test_both_libraries_draw_the_same_numbers(x_label: str) -> None:
    x = np.arange(4.0)

    def series(y: Array, style: str) -> Series:
        return Series(x=x, y=y, colour="#123456", label=style, style=style)  # type: ignore[arg-type]

    styles = {"line": x**2, "steps": x + 1.0, "points": x - 2.0}
    panel = Panel(
        title="a <b>",
        unit="m",
        series=tuple(series(y, style) for style, y in styles.items()),
        bounds=(Bound(value=5.0, start=1.0, stop=2.0),),
        bands=(Band(x=x, low=-x, high=x, colour="#654321"),),
        labels=(Label(x=1.0, y=2.0, text="<c>", colour="#abcdef", bold=True),),
        x_label=x_label,
        y_range=(-3.0, 9.0),
    )
    figure = Figure(key="k", title="t", panels=(panel,), columns=1, end=None if x_label else 3.0)
    (axes,) = draw(figure).axes
    lines = {line.get_drawstyle() + line.get_linestyle(): np.asarray(line.get_ydata()) for line in axes.get_lines()}
    assert axes.get_ylabel() == "a <b> [m]"
    assert axes.get_ylim() == (-3.0, 9.0)
    np.testing.assert_array_equal(lines["default-"], styles["line"])
    np.testing.assert_array_equal(lines["steps-post-"], styles["steps"])
    (text,) = axes.texts
    assert (text.get_text(), text.get_position(), text.get_color()) == ("<c>", (1.0, 2.0), "#abcdef")
    drawn = json.loads(to_plot(figure).json)
    assert "&lt;b&gt;" in drawn["layout"]["annotations"][0]["text"]
    assert drawn["layout"]["yaxis"]["range"] == [-3.0, 9.0]
    assert [trace["name"] for trace in drawn["data"] if "name" in trace] == [*styles, "bound"]
    label = drawn["layout"]["annotations"][1]
    assert (label["text"], label["x"], label["y"]) == ("<b>&lt;c&gt;</b>", 1.0, 2.0)
    assert label["font"]["color"] == "#abcdef"
    (bound,) = (trace for trace in drawn["data"] if trace.get("name") == "bound")
    assert (bound["x"], bound["y"], bound["line"]["color"]) == ([1.0, 2.0], [5.0, 5.0], COLOUR.bound)


def test_thinning_keeps_ends_extremes_and_gaps() -> None:
    values = np.random.default_rng(0).normal(size=10_007)
    values[[10, 5000]] = np.nan
    thinned = thinned_curve(values, 500)
    assert thinned.size <= 506
    assert np.all(np.diff(thinned) > 0)
    assert {0, 10, 5000, 10_006, int(np.nanargmin(values)), int(np.nanargmax(values))} <= set(thinned.tolist())
    np.testing.assert_array_equal(thinned_curve(values[:300], 300), np.arange(300))


def test_a_run_among_obstacles_is_drawn_from_above_with_its_clearances(short_run: Flight) -> None:
    pillar = Cylinder(name="pillar", position=(1.0, 0.0, 1.0), radius=0.1, height=3.0)
    limit = SpaceLimit(name="pillar", shape=pillar, radius=0.2)
    (figure,) = flight_figures.space(judged_by(short_run, limit))
    above, clearance = figure.panels
    np.testing.assert_allclose(np.hypot(*(above.areas[0].outline - [1.0, 0.0]).T), 0.1)
    assert [bound.value for bound in clearance.bounds] == [0.0]
    assert to_plot(figure).json.count('"toself"') == 1
    assert to_png(figure, dpi=30)


def test_every_signal_can_be_drawn(short_run: Flight) -> None:
    figure = flight_figures.signals([short_run], list(SIGNALS))
    assert [panel.unit for panel in figure.panels] == [signal.unit for signal in SIGNALS.values()]


@pytest.mark.parametrize(("top", "shown"), [(3.0, {"0.2", "0.5", "1", "2"}), (1e4, {"1", "100", "10000"})])
def test_a_logarithmic_axis_has_plain_numbers(top: float, shown: set[str]) -> None:
    series = Series(x=np.arange(2.0), y=np.array([0.13, top]), colour="black", label="a")
    canvas = draw(Figure(key="a", title="a", panels=(Panel(title="time", unit="ms", series=(series,), y_log=True),)))
    canvas.draw_without_rendering()
    texts = {text.get_text() for text in canvas.axes[0].yaxis.get_ticklabels(which="both")}
    assert shown <= texts
    assert not [text for text in texts if "$" in text]


def test_a_page_s_axes_have_plain_numbers_and_no_prefixes() -> None:
    """A tick of 33µ is nobody's unit: numbers are written out, and with a power of ten where they would be long."""
    x = np.arange(2.0)
    panels = []
    for y_log in (False, True):
        series = Series(x=x, y=np.array([1e-5, 3e-5]), colour="black", label="a")
        panels.append(Panel(title="time", unit="ms", series=(series,), y_log=y_log))
    layout = json.loads(to_plot(Figure(key="a", title="a", panels=tuple(panels), end=1.0)).json)["layout"]
    formats = {name: axis["exponentformat"] for name, axis in layout.items() if "axis" in name}
    assert formats == {"xaxis": "power", "yaxis": "power", "xaxis2": "power", "yaxis2": "none"}
    assert layout["yaxis"]["minexponent"] == 5


NO_EFFECTS: dict[str, Any] = {"wrench": None, "wind": None, "battery": None}


def log_with(*, speeds: Array | float = 0.0, **effects: Array) -> FlightLog:
    """Four periods of 0.1 s with five plant rows each, and one at the end; ideal but for what is given."""
    log = small_log(4, steps=5)
    held = np.concatenate([np.repeat(log.control.speeds, 5, axis=0), log.control.speeds[-1:]])
    return replace(log, plant=replace(log.plant, speeds=held + speeds, **(NO_EFFECTS | effects)))


def test_forces_torques_wind_and_battery_have_curves_unless_they_are_zero_throughout() -> None:
    assert effect_curves(log_with()) == []
    wrench = np.zeros((21, 6))
    assert effect_curves(log_with(wrench=wrench, wind=np.zeros((21, 3)))) == []
    wrench[7, 4] = 0.5
    (torque,) = effect_curves(log_with(wrench=wrench))
    np.testing.assert_array_equal(torque.values, wrench[:, 3:])
    curves = effect_curves(log_with(wrench=np.ones((21, 6)), wind=np.ones((21, 3))))
    assert [(entry.key, entry.unit) for entry in curves] == [("force", "N"), ("torque", "N m"), ("wind", "m/s")]
    curves = effect_curves(log_with(battery=np.ones((21, 2))))
    assert [(entry.key, entry.unit, entry.names) for entry in curves] == [
        ("voltage", "V", ("voltage",)),
        ("charge", "-", ("charge",)),
    ]
    empty = replace(small_log(0), plant=replace(small_log(0).plant, **NO_EFFECTS))
    assert (commanded_speeds(empty), effect_curves(empty)) == (None, [])


def test_commands_hold_for_their_period_where_they_differ_from_the_speeds() -> None:
    assert commanded_speeds(log_with(speeds=1e-9)) is None, "rounding"
    log = log_with(speeds=-3.0 * (np.arange(84) == 22).reshape(21, 4))
    commanded = commanded_speeds(log)
    assert commanded is not None
    np.testing.assert_array_equal(commanded, log_with().plant.speeds)


@pytest.mark.parametrize(("unit", "span"), LEAST_SPANS.items())
def test_rounding_is_shown_as_a_line_at_the_middle_of_the_least_span(unit: str, span: float) -> None:
    rounding = 1e-12 * np.sin(np.arange(50.0))
    assert least_range([rounding, rounding[:3]], unit) == (-0.5 * span, 0.5 * span)
    assert least_range([1.5 + rounding], unit) == pytest.approx((1.5 - 0.5 * span, 1.5 + 0.5 * span))


def test_curves_that_move_apart_from_one_another_or_have_no_unit_fit_their_axis_to_them() -> None:
    assert least_range([np.zeros(5), np.ones(5)], "m") is None
    assert least_range([np.zeros(5), np.array([np.nan, np.inf, 1e-9])], "m") is not None
    assert least_range([np.zeros(5), np.array([0.02])], "m") is None
    assert least_range([np.zeros(5)], "N") is None
    assert least_range([], "m") is least_range([np.full(4, np.nan)], "deg") is None


def test_an_angle_has_a_gap_at_each_wrap_and_only_there() -> None:
    t = np.linspace(0.0, 2.0, 201)
    wrapped = (360.0 * t + 180.0) % 360.0 - 180.0  # two turns in two seconds
    times, values = break_at_wraps(t, wrapped, "deg")
    gaps = np.isnan(values)
    np.testing.assert_allclose(times[gaps], [0.495, 1.495])
    np.testing.assert_array_equal(values[~gaps], wrapped)
    np.testing.assert_array_equal(times[~gaps], t)
    assert break_at_wraps(t, wrapped, "rad/s")[1].size == t.size


def test_a_name_longer_than_its_axis_breaks_at_its_underscores() -> None:
    line = Series(x=np.arange(3.0), y=np.arange(3.0), colour="#123456", label="a")
    panel = Panel(title="vertical_acceleration_of_the_thrust", unit="m/s^2", series=(line,))
    label = draw(Figure(key="k", title="t", panels=(panel,) * 6, columns=1)).axes[0].get_ylabel()
    assert "_\n" in label
    assert label.replace("_\n", "_").replace("\n", " ") == panel.heading


def test_a_user_s_own_settings_change_no_figure_and_its_texts_are_literal() -> None:
    """With `text.usetex` a figure would need LaTeX, and `$` would open a formula."""
    series = (Series(x=np.arange(3.0), y=np.arange(3.0), colour="#000000", label="$\\frac"),)
    figure = Figure(key="k", title="costs $5, or 5$_", panels=(Panel(title="$^", unit="$", series=series),))
    expected = to_png(figure)
    with matplotlib.rc_context({"text.usetex": True, "axes.facecolor": "red", "font.size": 30.0, "lines.linewidth": 9}):
        assert to_png(figure) == expected
        assert figure_html(figure).count("$") >= 4
        assert matplotlib.rcParams["text.usetex"]


LABELS = ("constrained MPC, horizon of 50 periods", "infinite-horizon LQR", "cascaded PID", "bound", "reference")


def test_the_legend_of_a_figure_as_wide_as_a_column_takes_a_sixth_of_it_at_most() -> None:
    x = np.linspace(0.0, 1.0, 5)
    curves = tuple(Series(x=x, y=i * x, colour="#000000", label=label) for i, label in enumerate(LABELS))
    canvas = draw(Figure(key="k", title="", panels=(Panel(title="x", series=curves),) * 2, columns=1), width=3.5)
    canvas.draw_without_rendering()
    (legend,) = canvas.legends
    box = legend.get_window_extent()
    whole = canvas.bbox
    assert box.height < whole.height / 6.0
    assert 0.0 <= box.x0 < box.x1 <= whole.width


@pytest.mark.parametrize("style", [{"font.family": "serif"}, "sheet.mplstyle"])
def test_a_style_of_the_user_s_replaces_ours(style: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("sheet.mplstyle").write_text("font.family: serif\n")
    series = (Series(x=np.arange(3.0), y=np.arange(3.0), colour="#000000", label="one"),)
    figure = Figure(key="k", title="", panels=(Panel(title="x", series=series),))
    canvas = draw(figure, width=3.5, style=style)
    assert canvas.axes[0].yaxis.label.get_fontfamily() == ["serif"]
    assert canvas.axes[0].yaxis.label.get_fontsize() == 8.0
    assert draw(figure, width=3.5).axes[0].yaxis.label.get_fontfamily() == ["sans-serif"]


@pytest.mark.parametrize(
    ("style", "reason"),
    [("nostyle", "is not a valid package style"), ({"font.sze": 3}, "font.sze"), ({"font.size": "x"}, "to float")],
)
def test_a_style_that_matplotlib_does_not_know_is_refused(style: Any, reason: str) -> None:
    with pytest.raises(ParameterError, match=f"style must be rcParams of matplotlib, or a style sheet .*{reason}"):
        draw(Figure(key="k", title="", panels=(Panel(title="x"),)), width=3.5, style=style)


def test_a_figure_that_is_saved_later_has_fonts_that_journals_accept(tmp_path: Path) -> None:
    series = (Series(x=np.arange(3.0), y=np.arange(3.0), colour="#000000", label="one"),)
    figure = Figure(key="k", title="", panels=(Panel(title="x", series=series),))
    with matplotlib.rc_context({"backend": "agg"}):
        drawn = draw(figure, interactive=True, width=3.5)
    pickle.loads(pickle.dumps(drawn)).savefig(tmp_path / "later.pdf")
    content = (tmp_path / "later.pdf").read_bytes()
    assert b"/CIDFontType2" in content
    assert b"/Type3" not in content


def test_a_first_sample_far_off_does_not_flatten_what_follows() -> None:
    x = np.arange(200.0)
    y = np.sin(x)
    y[0] = 90.0
    curve = Series(x=x, y=y, colour="#000000", style="steps")
    panel = Panel(title="slew", unit="rad/s", series=(curve,), bounds=(Bound(value=2.0),))
    assert panel.fixed_range == pytest.approx((-1.15, 2.15), abs=0.01)
    assert panel.heading == "slew [rad/s], 90 at first"
    assert draw(Figure(key="k", title="", panels=(panel,))).axes[0].get_ylim() == panel.fixed_range
    y[0] = 4.0
    usual = replace(panel, series=(replace(curve, y=y),))
    assert usual.fixed_range is None
    assert usual.heading == "slew [rad/s]"
    assert replace(panel, x_label="speed [m/s]").fixed_range is None, "it is no time"


def test_matplotlib_s_notices_on_a_home_that_it_cannot_write_stay_quiet(tmp_path: Path) -> None:
    code = "import numpy as np; from quadsim.report.figure import *; from quadsim.report.to_matplotlib import to_png\n"
    code += "print(len(to_png(Figure(key='k', title='t', panels=(Panel(title='a', unit='-'),)))))"
    (tmp_path / "file").write_text("")
    outside = {name: value for name, value in os.environ.items() if not name.startswith(("XDG", "MPL"))}
    nowhere = {**outside, "HOME": str(tmp_path / "file" / "home")}
    done = subprocess.run([sys.executable, "-c", code], env=nowhere, capture_output=True, text=True, check=True)
    assert int(done.stdout) > 1000
    assert done.stderr == ""
