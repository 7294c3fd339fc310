"""Vehicles as MJCF, SDF, URDF, a mixer's geometry and a RotorPy dictionary have them: their first flights."""

from __future__ import annotations

import pytest
from first_flights import fly_first
from uneven import PUBLISHED, published, uneven


@pytest.mark.parametrize("course", ["step", "figure-eight"])
@pytest.mark.parametrize("name", [*PUBLISHED, "uneven"])
def test_it_flies_a_step_and_a_figure_eight(name: str, course: str) -> None:
    flight = fly_first(uneven() if name == "uneven" else published(name), course, "robust")
    assert flight.outcome == "satisfied"
    assert flight.rms < 0.06


@pytest.mark.parametrize(("law", "course"), [("lqr", "hover"), ("pid", "figure-eight"), ("geometric", "figure-eight")])
@pytest.mark.parametrize("name", ["deadcat", "uneven"])
def test_every_law_flies_about_the_trim_of_unequal_rotors(name: str, law: str, course: str) -> None:
    flight = fly_first(uneven() if name == "uneven" else published(name), course, law)
    assert flight.outcome == "satisfied"
