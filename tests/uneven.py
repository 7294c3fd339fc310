"""Vehicles of the field's files in `tests/vehicles`, and one with nothing alike, against hidden symmetry."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Final

from quadsim.vehicle import Vehicle, load_vehicle

FILES: Final = Path(__file__).with_name("vehicles")
PUBLISHED: Final = sorted(path.stem for path in FILES.glob("*.toml"))


def published(name: str) -> Vehicle:
    """Return a vehicle with the numbers of its public file."""
    return load_vehicle(FILES / f"{name}.toml")


def uneven() -> Vehicle:
    """Return a dead cat with hubs at different heights, four thrust coefficients, and all products of inertia."""
    return replace(
        published("deadcat"),
        name="uneven",
        products_of_inertia=(0.001, -0.002, 0.0005),
        rotor_positions=((0.12, -0.24, 0.03), (-0.18, 0.2, -0.01), (0.11, 0.245, 0.02), (-0.19, -0.18, 0.04)),
        thrust_coefficient=(1.5e-5, 1.6e-5, 1.4e-5, 1.55e-5),
    )
