"""The figures: there, not blank, of the right content, and the same bytes each time."""

import dataclasses
import xml.etree.ElementTree as ElementTree
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from quadsim.errors import OutputError
from quadsim.flight.audit import Limit
from quadsim.flight.rundir import Run
from quadsim.report.figures import flight_figures
from quadsim.report.figures.canvas import write_drawings
from quadsim.report.figures.flight_figures import comparison_figure, draw_effects, has_effects, write_figures
from quadsim.report.palette import BOUND, line_colour
from quadsim.state import INDEX


@pytest.fixture(scope="module")
def figures(short_run: Run, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return {path.name: path for path in write_figures(short_run, tmp_path_factory.mktemp("figures") / "new")}


def texts(svg: Path) -> set[str]:
    return {
        text for element in ElementTree.parse(svg).iter("{http://www.w3.org/2000/svg}text") if (text := element.text)
    }


def lines_of_colour(svg: Path, colour: str) -> int:
    return svg.read_text().count(f"stroke: {colour}")


def states_svg(run: Run, directory: Path) -> Path:
    """The figure of the states alone, as text."""
    return write_drawings({"states": lambda: flight_figures._draw_states(run)}, directory)[1]


def named(run: Run, scenario: str) -> Run:
    return dataclasses.replace(run, summary={**run.summary, "scenario": scenario})


def test_the_papers_scenario_gives_the_papers_figure_numbers(figures: dict[str, Path]) -> None:
    assert list(figures) == [
        f"{name}.{kind}" for name in ("figure4_states", "figure5_inputs", "solve_times") for kind in ("png", "svg")
    ]


@pytest.mark.usefixtures("undrawn")
def test_another_scenario_gives_plain_names(short_run: Run, tmp_path: Path) -> None:
    stems = [path.stem for path in write_figures(named(short_run, "hover"), tmp_path)]
    assert stems == ["states", "states", "inputs", "inputs", "solve_times", "solve_times"]


def test_pictures_are_large_and_not_blank(figures: dict[str, Path]) -> None:
    for path in figures.values():
        if path.suffix == ".png":
            picture = imread(path)[..., :3]
            assert picture.shape[1] >= 1400
            assert 0.01 < np.mean(np.any(picture < 0.95, axis=-1)) < 0.5


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        (
            "figure4_states",
            {"x [m]", "y [m]", "z [m]", "roll [deg]", "pitch [deg]", "yaw [deg]", "reference, filtered"},
        ),
        ("figure5_inputs", {"rotor speed [rad/s]", "step per period [rad/s]", "rotor 1", "rotor 4", "bound"}),
        ("solve_times", {"time [ms]", "iterations", "active constraints", "deadline: 50 ms"}),
    ],
)
def test_panels_and_units_are_labelled(figures: dict[str, Path], name: str, expected: set[str]) -> None:
    assert expected | {"time [s]"} <= texts(figures[f"{name}.svg"])


@pytest.mark.usefixtures("sketched")
def test_bounds_are_drawn_where_the_flight_has_them(short_run: Run, figures: dict[str, Path], tmp_path: Path) -> None:
    bounds_and_legend = 2 * 2 + 1
    assert lines_of_colour(figures["figure4_states.svg"], BOUND) == bounds_and_legend
    assert lines_of_colour(figures["figure5_inputs.svg"], BOUND) == bounds_and_legend
    states = states_svg(dataclasses.replace(short_run, limits=()), tmp_path)
    assert lines_of_colour(states, BOUND) == 0
    assert "bound" not in texts(states)


@pytest.mark.usefixtures("sketched")
def test_a_bound_that_begins_after_the_flight_is_left_out(short_run: Run, tmp_path: Path) -> None:
    late = dataclasses.replace(short_run, limits=(Limit(name="late", signal="roll", upper=5.0, start=100.0),))
    assert lines_of_colour(states_svg(late, tmp_path), BOUND) == 0


def test_the_same_flight_gives_the_same_bytes(short_run: Run, figures: dict[str, Path], tmp_path: Path) -> None:
    drawings = {"figure5_inputs": flight_figures._draw_inputs, "solve_times": flight_figures._draw_solve_times}
    for again in write_drawings({name: partial(draw, short_run) for name, draw in drawings.items()}, tmp_path):
        assert again.read_bytes() == figures[again.name].read_bytes(), again.name


@pytest.mark.usefixtures("sketched")
def test_an_aborted_flight_is_drawn_as_far_as_it_went(short_run: Run, tmp_path: Path) -> None:
    log = dataclasses.replace(short_run.log, reason="at t = 6.000 s: lost")
    states = states_svg(dataclasses.replace(short_run, log=log), tmp_path)
    assert "paper-constrained (aborted): position and attitude" in texts(states)


def test_an_ideal_flight_has_no_figure_of_effects(figures: dict[str, Path]) -> None:
    assert "effects.png" not in figures


def with_effects(run: Run, *, wrench: bool = False, wind: bool = False, lag: bool = False, state: bool = False) -> Run:
    """The flight as if it had met with some effects."""
    plant, control = run.log.plant, run.log.control
    rng = np.random.default_rng(0)
    if wrench:
        plant = dataclasses.replace(plant, wrench=rng.normal(size=(plant.t.size, 6)))
    if wind:
        plant = dataclasses.replace(plant, wind=rng.normal(size=(plant.t.size, 3)))
    if lag:
        plant = dataclasses.replace(plant, speeds=plant.speeds + 1.0)
    if state:
        control = dataclasses.replace(control, state=control.state + 0.01)
    return dataclasses.replace(run, log=dataclasses.replace(run.log, plant=plant, control=control))


SPEEDS = {"rotor 1 [rad/s]", "rotor 4 [rad/s]", "commanded", "acting"}
FORCES = {"external force, world", "[N]", "external torque, body", "[N m]", "x", "y", "z"}
AIR = {"wind, world", "[m/s]", "x", "y", "z"}
STATE = {"position as measured,", "less the true one [m]", "less the true one [deg]", "x", "y", "z", "roll", "yaw"}


@pytest.mark.usefixtures("sketched")
@pytest.mark.parametrize(("effect", "expected"), [("lag", SPEEDS), ("wrench", FORCES), ("wind", AIR), ("state", STATE)])
def test_effects_are_drawn_where_there_are_any(short_run: Run, tmp_path: Path, effect: str, expected: set[str]) -> None:
    """Each by itself, with its panels and no others."""
    run = with_effects(short_run, **{effect: True})
    assert has_effects(run)
    write_drawings({"effects": lambda: draw_effects(run)}, tmp_path)
    found = texts(tmp_path / "effects.svg")
    assert expected | {"time [s]", "paper-constrained: effects"} <= found
    others = (SPEEDS | FORCES | AIR | STATE) - expected
    assert not others & found


@pytest.mark.usefixtures("coarse")
def test_all_effects_are_drawn_together(short_run: Run, tmp_path: Path) -> None:
    run = with_effects(short_run, wrench=True, wind=True, lag=True, state=True)
    write_drawings({"effects": lambda: draw_effects(run)}, tmp_path)
    assert texts(tmp_path / "effects.svg") >= SPEEDS | FORCES | AIR | STATE
    picture = imread(tmp_path / "effects.png")[..., :3]
    assert 0.01 < np.mean(np.any(picture < 0.95, axis=-1)) < 0.5


@pytest.mark.usefixtures("undrawn")
def test_effects_are_a_figure_of_the_run(short_run: Run, tmp_path: Path) -> None:
    assert tmp_path / "effects.png" in write_figures(with_effects(short_run, wind=True), tmp_path)


def test_no_figures_without_a_control_period(empty_run: Run, tmp_path: Path) -> None:
    assert write_figures(empty_run, tmp_path) == []


@pytest.mark.usefixtures("sketched")
def test_a_comparison_names_every_run_once(short_run: Run, tmp_path: Path) -> None:
    png, svg = comparison_figure([short_run, named(short_run, "other $x$ <b>")], tmp_path)
    assert png.name == "comparison.png"
    assert {"paper-constrained", "other $x$ <b>", "bound", "roll [deg]"} <= texts(svg)
    bounds_of_roll_pitch_speed_and_legend = 3 * 2 + 1
    assert lines_of_colour(svg, BOUND) == bounds_of_roll_pitch_speed_and_legend


def test_a_place_that_cannot_be_written_is_reported(short_run: Run, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match="cannot write"):
        write_figures(short_run, tmp_path / "file" / "figures")


def standing(run: Run) -> Run:
    """The flight as if it had stood still but for rounding, and not been held to anything."""
    rng = np.random.default_rng(0)
    plant = dataclasses.replace(run.log.plant, state=1e-12 * rng.normal(size=run.log.plant.state.shape))
    control = dataclasses.replace(run.log.control, reference=np.zeros_like(run.log.control.reference))
    return dataclasses.replace(run, limits=(), log=dataclasses.replace(run.log, plant=plant, control=control))


@pytest.mark.usefixtures("sketched")
def test_rounding_is_drawn_as_a_level_line(short_run: Run, tmp_path: Path) -> None:
    found = texts(states_svg(standing(short_run), tmp_path))
    assert {"0.004", "0.04"} <= found, "metres and degrees"
    assert not any(text.startswith("1e") for text in found)


def test_a_roll_that_wraps_is_no_line_across_the_panel(short_run: Run) -> None:
    state = short_run.log.plant.state.copy()
    state[:, INDEX["roll"]] = (4.0 * short_run.log.plant.t + np.pi) % (2.0 * np.pi) - np.pi
    log = dataclasses.replace(short_run.log, plant=dataclasses.replace(short_run.log.plant, state=state))
    drawn = flight_figures._draw_states(dataclasses.replace(short_run, log=log))
    (roll,) = (axes for axes in drawn.axes if axes.get_ylabel() == "roll [deg]")
    values = np.asarray(roll.get_lines()[0].get_ydata())
    assert np.nanmax(values) - np.nanmin(values) > 350.0
    assert np.nanmax(np.abs(np.diff(values))) < 10.0


@pytest.mark.usefixtures("sketched")
def test_states_are_drawn_as_measured_beside_the_true_ones(
    short_run: Run, figures: dict[str, Path], tmp_path: Path
) -> None:
    assert "measured" not in texts(figures["figure4_states.svg"])
    states = states_svg(with_effects(short_run, state=True), tmp_path)
    assert {"flight", "measured"} <= texts(states)
    drawn = lines_of_colour(states, line_colour(1))
    assert drawn - lines_of_colour(figures["figure4_states.svg"], line_colour(1)) == 6 + 1, "six panels and the legend"


def test_each_panel_of_effects_has_a_legend_of_its_own(short_run: Run) -> None:
    figure = draw_effects(with_effects(short_run, wind=True, state=True))
    legends = {axes.get_ylabel().split()[0]: axes.get_legend() for axes in figure.axes}
    named = {what: [text.get_text() for text in legend.get_texts()] for what, legend in legends.items() if legend}
    assert named == {"wind,": ["x", "y", "z"], "position": ["x", "y", "z"], "attitude": ["roll", "pitch", "yaw"]}
    assert not figure.legends
