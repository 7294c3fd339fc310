"""The drawing of a vehicle: what matplotlib draws is where the file says, and turns as the plant does."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb

from quadsim.assets import vehicle_names, vehicle_path
from quadsim.palette import COLOUR
from quadsim.report.to_matplotlib import draw
from quadsim.report.vehicle_drawing import vehicle_figure
from quadsim.state import Array
from quadsim.vehicle import Vehicle, load_vehicle

FILES = Path(__file__).resolve().parents[1] / "vehicles"
VEHICLES = [load_vehicle(path) for path in (*map(vehicle_path, vehicle_names()), *sorted(FILES.glob("*.toml")))]
EVERY = pytest.mark.parametrize("vehicle", VEHICLES, ids=lambda vehicle: vehicle.name)


def drawn(vehicle: Vehicle) -> Axes:
    (axes,) = draw(vehicle_figure(vehicle)).axes
    return axes


def texts(axes: Axes) -> dict[str, Array]:
    """Where each text that occurs once is, in body axes [m]."""
    counts = Counter(text.get_text() for text in axes.texts)
    return {t.get_text(): in_body(np.array(t.get_position())) for t in axes.texts if counts[t.get_text()] == 1}


def in_body(place: Array) -> Array:
    """(..., 2) x, y in body axes of places to the right and up on the page."""
    return np.stack([place[..., 1], -place[..., 0]], axis=-1)


@EVERY
def test_each_rotor_is_numbered_at_its_hub_and_says_where_it_is(vehicle: Vehicle) -> None:
    axes = drawn(vehicle)
    radius = vehicle.rotor_radius or 0.5 * vehicle.closest_rotors
    where = texts(axes)
    discs = [in_body(patch.get_xy()) for patch in axes.patches if patch.get_alpha() < 0.5]
    assert len(discs) == 4
    for number, (hub, disc) in enumerate(zip(vehicle.hubs, discs, strict=True), start=1):
        np.testing.assert_allclose(np.hypot(*(disc - hub[:2]).T), radius)
        assert math.dist(where[str(number)], hub[:2]) < 0.5 * radius
        near = [
            t.get_text() for t in axes.texts if math.dist(in_body(np.array(t.get_position())), hub[:2]) < radius / 2
        ]
        assert len(near) == 3
        stated = [float(value) for value in near[1].split(", ")]
        np.testing.assert_allclose(stated, hub[: len(stated)], atol=0.006 * vehicle.longest_arm)
        assert len(stated) == (3 if np.any(vehicle.hubs[:, 2]) else 2)
        assert float(near[2].removeprefix("arm ")) == pytest.approx(math.hypot(*hub[:2]), rel=0.02)


@EVERY
def test_arrows_turn_against_the_torque_that_the_rotors_give_the_body(vehicle: Vehicle) -> None:
    """The last row of the allocation matrix has the torque about body z, counter-clockwise from above."""
    axes = drawn(vehicle)
    (legend,) = axes.figure.legends
    meaning = {line.get_color(): text.get_text() for line, text in zip(legend.get_lines(), legend.texts, strict=True)}
    assert {*meaning.values()} == {"turns clockwise", "turns counter-clockwise"}
    rotors = [line for line in axes.get_lines() if line.get_color() in meaning]
    heads = [in_body(patch.get_xy()) for patch in axes.patches if patch.get_facecolor()[:3] in map(to_rgb, meaning)]
    tips = [head[1] for head in heads if len(head) == 4]  # a triangle, closed
    for torque, hub, line, tip in zip(vehicle.allocation[3], vehicle.hubs, rotors, tips, strict=True):
        x, y = (in_body(line.get_xydata()) - hub[:2]).T
        np.testing.assert_allclose((x[-1], y[-1]), tip - hub[:2])
        turned = np.unwrap(np.arctan2(y, x))
        assert abs(turned[-1] - turned[0]) == pytest.approx(math.radians(270.0))
        assert np.sign(turned[-1] - turned[0]) == -np.sign(torque)
        assert (meaning[line.get_color()] == "turns clockwise") == (torque > 0.0)


@EVERY
def test_front_axes_and_arms_point_as_the_body_does(vehicle: Vehicle) -> None:
    axes = drawn(vehicle)
    where = texts(axes)
    lines = {line.get_color(): in_body(line.get_xydata()) for line in axes.get_lines()}
    for colour, direction in ((COLOUR.axis_x, (1.0, 0.0)), (COLOUR.axis_y, (0.0, 1.0))):
        start, end = lines[colour]
        np.testing.assert_array_equal(start, [0.0, 0.0])
        np.testing.assert_allclose(end / np.hypot(*end), direction, atol=1e-12)
    assert where["front"][0] > vehicle.hubs[:, 0].max()
    assert where["x"][0] > abs(where["x"][1])
    assert where["y"][1] > abs(where["y"][0])
    arms = [in_body(line.get_xydata()) for line in axes.get_lines() if line.get_color() == COLOUR.measured]
    for (start, end), hub in zip(arms, vehicle.hubs[:, :2], strict=True):
        np.testing.assert_array_equal(start, [0.0, 0.0])
        assert end @ hub == pytest.approx(np.hypot(*end) * np.hypot(*hub))
    assert axes.get_aspect() == 1.0


def test_another_order_of_the_rotors_is_another_drawing() -> None:
    vehicle = load_vehicle(FILES / "deadcat.toml")
    order = [1, 0, 3, 2]
    changed = replace(
        vehicle,
        rotor_positions=tuple(vehicle.rotor_positions[i] for i in order),
        rotor_spins=tuple(vehicle.rotor_spins[i] for i in order),
    )
    before = texts(drawn(vehicle))
    after = texts(drawn(changed))
    np.testing.assert_array_equal(before["1"], after["2"])
    np.testing.assert_array_equal(before["2"], after["1"])


def test_the_size_is_stated_and_an_unknown_propeller_too() -> None:
    (known,) = (vehicle for vehicle in VEHICLES if vehicle.name == "hummingbird")
    assert "0.54 m across" in drawn(known).get_title(loc="left")  # 2 (0.17 + 0.1)
    unknown = replace(known, rotor_radius=None)
    assert "unknown size" in drawn(unknown).get_title(loc="left")


def test_a_rotor_at_the_centre_of_mass_has_no_arm() -> None:
    (vehicle,) = (vehicle for vehicle in VEHICLES if vehicle.name == "cf2x")
    places = ((0.0, -1e-17, 0.0), (0.04, 0.0, 0.0), (-0.02, 0.035, 0.0), (-0.02, -0.035, 0.0))
    axes = drawn(replace(vehicle, rotor_positions=places, rotor_spins=(1, -1, -1, -1), speed_max=4000.0))
    assert {"0.0000, 0.0000", "arm 0.0000"} <= {text.get_text() for text in axes.texts}
    assert sum(line.get_color() == COLOUR.measured for line in axes.get_lines()) == 3
