"""Vehicles as MJCF, SDF, URDF, a mixer's geometry and a RotorPy dictionary have them: their first flights."""

from __future__ import annotations

import re

import pytest
from first_flights import fly_first
from uneven import FILES, PUBLISHED, published, uneven

from quadsim.commands.cli import main
from quadsim.console.results import EXIT_DONE

FIRST = [(name, course) for name in (*PUBLISHED, "uneven") for course in ("step", "figure-eight")]
QUICK = (("iris", "step"), ("uneven", "figure-eight"))


@pytest.mark.slow("vehicles")
@pytest.mark.parametrize(
    ("name", "course"),
    [
        *[pytest.param(*pair, marks=pytest.mark.representative("vehicles")) for pair in QUICK],
        *[p for p in FIRST if p not in QUICK],
    ],
)
def test_it_flies_a_step_and_a_figure_eight(name: str, course: str) -> None:
    flight = fly_first(uneven() if name == "uneven" else published(name), course, "robust")
    assert flight.outcome == "satisfied"
    assert flight.rms < 0.06


@pytest.mark.parametrize(("law", "course"), [("lqr", "hover"), ("pid", "figure-eight"), ("geometric", "figure-eight")])
@pytest.mark.parametrize("name", [pytest.param("deadcat", marks=pytest.mark.slow("vehicles")), "uneven"])
def test_every_law_flies_about_the_trim_of_unequal_rotors(name: str, law: str, course: str) -> None:
    flight = fly_first(uneven() if name == "uneven" else published(name), course, law)
    assert flight.outcome == "satisfied"


def test_its_report_names_the_speed_of_each_rotor(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["vehicle", str(FILES / "deadcat.toml")]) == EXIT_DONE
    printed = capsys.readouterr().out
    assert re.search(r"of rotor 1 +512\.9 rad/s", printed)
    assert re.search(r"of rotor 2 +402\.5 rad/s", printed)
    assert re.search(r"rotor_positions +0\.1155, -0\.245, 0, ", printed)
    assert main(["vehicle", str(FILES / "iris.toml")]) == EXIT_DONE
    assert "of rotor" not in capsys.readouterr().out.partition("thrust of one rotor")[0]
