"""What `import quadsim` hands out of vehicles: their numbers, what they can do, and a scenario made for them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from quadsim.assets import vehicle_path
from quadsim.errors import ParameterError
from quadsim.vehicle import Vehicle, vehicle_sources
from quadsim.vehicle import load_vehicle as read_vehicle

if TYPE_CHECKING:
    from scenarios.design.first_scenario import FirstScenario
    from scenarios.design.vehicle_figures import VehicleReport


def load_vehicle(name: str | Path) -> Vehicle:
    """The numbers of a vehicle.

    Args:
        name: of one that ships, or a path ending in `.toml`.

    Raises:
        InputError: there is none, or it cannot fly.

    Examples:
        >>> import quadsim
        >>> vehicle = quadsim.load_vehicle("hummingbird")
        >>> vehicle.mass, round(vehicle.hover_speed)
        (0.716, 453)
    """
    return read_vehicle(vehicle_path(str(name)))


def vehicle_report(name: str | Path, *, scenario: str | Path | None = None) -> VehicleReport:
    """What a vehicle can do, and which bounds of a scenario it cannot meet.

    Args:
        name: of one that ships, or a path ending in `.toml`.
        scenario: name or file of one to hold it against, whatever vehicle that has itself.

    Returns:
        Its numbers with their sources, `figures` that follow from them, `shortfalls` where a scenario is given.

    Raises:
        InputError: there is no such vehicle or scenario, or it cannot fly.

    Examples:
        >>> import quadsim
        >>> can = quadsim.vehicle_report("hummingbird", scenario="paper-constrained")
        >>> round(can.figures.thrust_to_weight, 2), round(can.figures.steady_tilt)  # [-], [deg]
        (3.42, 73)
        >>> can.figures.designed.limited_by, round(can.figures.designed.time_constants["x, y"], 2)  # [s]
        ('torque', 0.18)
        >>> can.shortfalls[0]
        'controller.input_bounds.speed: hover is 453.2 rad/s, the scenario allows 250'
    """
    from scenarios.design.shortfalls import shortfalls
    from scenarios.design.vehicle_figures import VehicleReport, make_sheet

    path = vehicle_path(str(name))
    loaded, missed = read_vehicle(path), None
    if scenario is not None:
        from scenarios.loading import load_scenario

        missed = shortfalls(load_scenario(str(scenario)), loaded)
    return VehicleReport(
        vehicle=loaded,
        sources=vehicle_sources(path),
        figures=make_sheet(loaded),
        scenario=None if scenario is None else str(scenario),
        shortfalls=missed,
    )


def vehicle_template() -> str:
    """A commented vehicle file to fill in: every parameter with its unit, and how to measure or estimate it.

    Returns:
        Its text, which is the file of a vehicle that flies.

    Examples:
        >>> import quadsim
        >>> text = quadsim.vehicle_template()
        >>> "[mass]" in text, "kg" in text
        (True, True)
    """
    return (Path(__file__).parent / "design" / "vehicle_template.toml").read_text(encoding="utf-8")


def draw_vehicle(name: str | Path, out: str | Path, *, overwrite: bool = False) -> Path:
    """Draw a vehicle on a floor of 10 cm squares.

    Args:
        name: of one that ships, or a path ending in `.toml`.
        out: a PNG file.
        overwrite: whether to replace a file that is there.

    Returns:
        The file.

    Raises:
        InputError: there is no such vehicle, or the file has another ending.
        RenderingUnavailableError: nothing can render here.
        OutputError: the file cannot be written.

    Examples:
        >>> import tempfile, quadsim
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = quadsim.draw_vehicle("crazyflie2", folder + "/crazyflie2.png")
        ...     file.stat().st_size > 1000
        True
    """
    from quadsim.report.film.video import render_portrait

    loaded = load_vehicle(name)
    if Path(out).suffix != ".png":
        raise ParameterError("", "--out", str(out), "a file ending in .png")
    render_portrait(loaded, Path(out), overwrite=overwrite)
    return Path(out)


def first_scenario(vehicle: str | Path, *, course: str = "hover", controller: str = "robust") -> FirstScenario:
    """A scenario that a vehicle flies well, its weights, bounds, horizon and period made from the vehicle's numbers.

    Args:
        vehicle: name of one that ships, or a path ending in `.toml`.
        course: hover, step (of 1 m) or figure-eight (at 60 % of what the vehicle can do).
        controller: robust, or lqr, pid, geometric; all have to meet the same requirements.

    Returns:
        The `scenario` to fly; `to_toml()`, its file, gives the source of each number; `notes` sums that up.

    Raises:
        InputError: there is no such vehicle, course or controller, or hover leaves nothing to control the vehicle with.

    Examples:
        >>> import quadsim
        >>> first = quadsim.first_scenario("hummingbird", course="figure-eight")
        >>> first.scenario.control_period, first.scenario.reference.length  # [s], [m]
        (0.025, 1.69)
        >>> quadsim.fly(first.scenario).outcome
        'satisfied'
    """
    from scenarios.design.first_scenario import first_scenario as make_first

    return make_first(load_vehicle(vehicle), str(vehicle), course=course, law=controller)
