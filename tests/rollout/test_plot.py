"""`quadsim.plot`, `Flight.plot` and `quadsim plot`: flights over one another, on screen or for a paper."""

from __future__ import annotations

import shlex
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.image import imread

import quadsim
from quadsim.commands.cli import main
from quadsim.console.results import EXIT_DONE, EXIT_WRONG_INPUT
from quadsim.errors import InputError, OutputError, ParameterError, UnknownNameError
from quadsim.palette import COLOUR, CYCLE, line_colour
from quadsim.report.flight_figures import signals
from quadsim.report.to_matplotlib import draw
from quadsim.rollout.flown import Flight

mpl.use("Agg")


@pytest.fixture(scope="module")
def pair() -> tuple[Flight, Flight]:
    """The paper's vehicle under its constrained MPC and under a PID controller, both towards a step."""
    scenario = quadsim.load("paper-constrained", {"duration": 0.5, "constraints": []})
    pid = scenario.replace({"controller": {"type": "pid"}})
    return quadsim.fly(scenario, progress=False), quadsim.fly(pid, progress=False)


@pytest.fixture(scope="module")
def saved(pair: tuple[Flight, Flight], tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    folder = tmp_path_factory.mktemp("runs")
    nothing = {"video": False, "recording": False, "figures": False}
    return [str(flight.save(folder / name, **nothing)) for flight, name in zip(pair, "ab", strict=True)]  # type: ignore[arg-type]


def test_flights_lie_over_one_another_with_reference_and_bounds(pair: tuple[Flight, Flight]) -> None:
    axes = quadsim.plot(pair, "z", "speed", "error", "step_ms", labels=["mine", "theirs"])
    (reference, *curves) = axes[0].get_lines()
    assert [curve.get_color() for curve in (reference, *curves)] == [COLOUR.reference, line_colour(0), line_colour(1)]
    for curve, flight in zip(curves, pair, strict=True):
        np.testing.assert_array_equal(curve.get_ydata(), flight.plant["z"])
    errors = [np.sqrt(sum((flight.state[name] - flight.reference[name]) ** 2 for name in "xyz")) for flight in pair]
    for curve, error in zip(axes[2].get_lines(), errors, strict=True):
        np.testing.assert_allclose(curve.get_ydata(), error)
    assert (axes[1].get_ylabel(), len(axes[1].collections)) == ("speed, all rotors\n[rad/s]", 4)  # 2 ranges, 2 bounds
    assert axes[3].get_yscale() == "log"
    (legend,) = axes[0].figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["reference, filtered", "mine", "theirs", "bound"]


def test_a_margin_is_the_audit_s_with_its_bound_at_zero(pair: tuple[Flight, Flight]) -> None:
    panel, step = signals(pair, ["margin.pitch", "margin.slew"]).panels
    assert (panel.heading, [bound.value for bound in panel.bounds]) == ("margin of pitch [deg]", [0.0])
    assert len(panel.series) == len(step.series) == 1, "a PID controller has no bounds"
    assert panel.series[0].y.min() == pair[0].margins["pitch"].min()
    assert (step.series[0].style, step.series[0].y.min()) == ("steps", pair[0].margins["slew"].min())


def test_one_flight_is_plotted_by_the_same_function(pair: tuple[Flight, Flight], saved: list[str]) -> None:
    names = ("command", "speed_2", "margin.roll", "xy")
    drawn = [plot(*names) for plot in (pair[0].plot, lambda *names: quadsim.plot(pair[0], *names))]
    drawn.append(quadsim.plot(saved[0], *names))
    labels = [[axes.get_ylabel() for axes in plot] for plot in drawn]
    assert labels[0] == labels[1] == labels[2]
    assert labels[0][0] == "commanded rotor\nspeed [rad/s]"
    assert len(drawn[0][0].get_lines()) == 4
    assert len(drawn[0][1].collections) == 2, "the bounds of every rotor"
    assert [text.get_text() for text in pair[0].plot("z", labels=["A"])[0].figure.legends[0].get_texts()][1] == "A"


@pytest.mark.parametrize(("suffix", "begins"), [(".pdf", b"%PDF"), (".svg", b"<?xml"), (".png", b"\x89PNG")])
def test_a_file_has_the_width_of_a_journal_and_the_same_bytes(
    pair: tuple[Flight, Flight], tmp_path: Path, suffix: str, begins: bytes
) -> None:
    files = [tmp_path / f"{name}{suffix}" for name in "ab"]
    for file in files:
        quadsim.plot(pair, "z", "margin.pitch", width=3.5, out=file)
    content = files[0].read_bytes()
    assert content.startswith(begins)
    assert content == files[1].read_bytes()
    if suffix == ".png":
        assert imread(files[0]).shape[1] == round(3.5 * 300)
    if suffix == ".pdf":
        assert b"/Type3" not in content, "journals refuse such fonts"
    with pytest.raises(OutputError, match="exists"):
        quadsim.plot(pair, "z", out=files[0])
    assert quadsim.plot(pair, "z", out=files[0], overwrite=True).path == files[0]


def test_a_legend_is_not_wider_than_its_figure(pair: tuple[Flight, Flight]) -> None:
    labels = ["robust MPC with soft constraints", "nominal MPC with hard constraints"]
    canvas = quadsim.plot(pair, "z", "speed", labels=labels, width=3.5)[0].figure
    canvas.draw_without_rendering()
    box = canvas.legends[0].get_window_extent()
    assert 0.0 <= box.x0 <= box.x1 <= canvas.bbox.width


def test_where_colours_repeat_lines_are_dashed(pair: tuple[Flight, Flight]) -> None:
    runs = [pair[0].labelled(str(i)) for i in range(len(CYCLE) + 1)]
    first, *_, last = draw(signals(runs, ["tilt"]), width=7.0).axes[0].get_lines()
    assert first.get_color() == last.get_color()
    assert (first.get_linestyle(), last.get_linestyle()) == ("-", "--")


def test_what_cannot_be_plotted_is_refused(pair: tuple[Flight, Flight], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="flights"):
        quadsim.plot([], "x")
    with pytest.raises(UnknownNameError, match=r"'margin\.rol'"):
        quadsim.plot(pair, "margin.rol")
    with pytest.raises(ParameterError, match="labels"):
        quadsim.plot(pair, labels=["a"])
    for width in (0.5, float("nan")):
        with pytest.raises(ParameterError, match="width"):
            quadsim.plot(pair, width=width)
    with pytest.raises(ParameterError, match="out"):
        quadsim.plot(pair, out=tmp_path / "a.jpg")
    limits = (
        {"name": "end", "signal": "yaw", "lower": -90.0, "upper": 90.0},
        {"name": "end", "signal": "x", "upper": 9.0},
    )
    flights = [quadsim.fly(quadsim.load("hover", {"duration": 0.1, "constraints": [limit]})) for limit in limits]
    with pytest.raises(InputError, match=r"margin\.end"):
        quadsim.plot(flights, "margin.end")


def test_the_command_writes_the_file_or_says_that_there_is_no_display(
    saved: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "fig.pdf"
    words = ["plot", *saved, "--signals", "z", "margin.roll", "--labels", "mpc", "pid", "--width", "3.5"]
    assert main([*words, "--out", str(file)]) == EXIT_DONE
    assert capsys.readouterr().out.splitlines() == [f"written to {file}", f"open {shlex.quote(str(file))}"]
    assert file.read_bytes().startswith(b"%PDF")
    assert main(words) == EXIT_WRONG_INPUT
    assert "no display to show the plot on; write it to a file: --out plot.pdf" in capsys.readouterr().err
