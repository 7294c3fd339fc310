"""The commands that start a scenario and a vehicle of one's own: `quadsim scenario` and `quadsim vehicle`.

`scenario` prints a resolved file, or one with weights, bounds and course scaled for a vehicle; `vehicle` prints a
template, or what a vehicle can do (thrust to weight, fastest flight, endurance).
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from cyclopts import Parameter

from quadsim.assets import vehicle_names
from quadsim.errors import InputError, ParameterError
from quadsim.features.arguments import Changes, File, Flag, ScenarioName, VehicleName, Watched, Whole
from quadsim.scenarios.catalogue import scenario_names

if TYPE_CHECKING:
    from collections.abc import Callable

    from quadsim.console.results import Document
    from quadsim.features.design.vehicle_report import VehicleReport
    from quadsim.scenarios.loading import ScenarioFile
    from quadsim.vehicle import Vehicle
else:
    Document = ScenarioFile = VehicleReport = Any

_TEMPLATE: Final = Path(__file__).with_name("vehicle_template.toml")


def scenario(
    name: ScenarioName | None = None,
    /,
    *,
    changes: Changes = (),
    seed: Whole | None = None,
    vehicle: Annotated[VehicleName | None, Parameter(name="--for")] = None,
    course: str | None = None,
    controller: str | None = None,
    tilt: float | None = None,
    size: float | None = None,
    fastest: Flag = False,
    margin: float | None = None,
    schema: Flag = False,
    progress: Watched = True,
) -> ScenarioFile:
    """Print a scenario with all defaults and comments, as a start for your own.

    Args:
        name: library name, or path to a TOML file.
        changes: replace a field of the scenario, e.g. --set controller.horizon=30; may be repeated.
        seed: replace the seed of everything random in the scenario.
        vehicle: print a first scenario for this vehicle instead.
        course: its course, at 60 % of the vehicle's limits: hover, step (of 1 m), figure-eight, a scenario of the
            library or a path to one (.toml), or a path to a trajectory (.csv) (default: hover).
        controller: its controller: robust, lqr, pid, geometric or nonlinear, or rates for nonlinear MPC of thrust and
            body rates through its autopilot (default: robust).
        tilt: its tilt bound [deg] (default: by rule, at most 40).
        size: longest side of the course [m] (default: by rule; of a scenario by the vehicles' extents, of a trajectory
            as it is).
        fastest: fly the course at the largest speed at which every bound holds with the margin, found by bisection of
            audited flights.
        margin: share of half of each bound's band that --fastest leaves (default: 0.1); 0: within tolerances.
        schema: print the JSON Schema of scenario files instead.
        progress: whether to show a bar of the flights of --fastest on a terminal, elsewhere a line every ten seconds.

    Returns:
        The `content` of the file, where every number has its unit or source, and the `scenario` itself.

    Raises:
        InputError: there is no such vehicle, course or controller, they do not fit together, or no speed holds.

    Examples:
        >>> import quadsim
        >>> quadsim.scenario("hover").scenario.vehicle.mass  # [kg]
        4.0
        >>> first = quadsim.scenario(vehicle="hummingbird", course="figure-eight").scenario
        >>> first.control_period, first.reference.length  # [s], [m]
        (0.025, 1.69)
        >>> quadsim.fly(first).outcome
        'satisfied'
    """
    import json

    from quadsim.scenarios import loading
    from quadsim.scenarios.courses.csv_course import Csv
    from quadsim.scenarios.schema.json_schema import scenario_schema

    if schema:
        return loading.ScenarioFile(json.dumps(scenario_schema(), indent=2) + "\n", scenario_schema())
    options = {"course": course, "controller": controller, "tilt": tilt, "size": size, "margin": margin}
    choice: dict[str, Any] = {option: value for option, value in options.items() if value is not None}
    if vehicle is not None:
        for option, value in {"a scenario": name, "--set": changes, "--seed": seed}.items():
            if value:
                raise ParameterError("", "--for", vehicle, f"given without {option}")
        return _for_vehicle(str(vehicle), choice, fastest=fastest, progress=progress)
    if fastest:
        raise ParameterError("", "--fastest", fastest, "given with --for alone")
    for option, value in choice.items():
        raise ParameterError("", f"--{option}", value, "given with --for alone")
    if name is None:
        names = ", ".join(scenario_names())
        raise InputError(f"scenario needs a name or a TOML file, or --schema (there are: {names})")
    assembly = loading.assemble(name, changes, seed)
    table = assembly.scenario.reference
    if isinstance(table, Csv):  # so that you may replace the file
        assembly = assembly.of(assembly.scenario.altered(reference=replace(table, sha256=None)))
    return loading.ScenarioFile(assembly.to_toml())


def _for_vehicle(
    file: str, choice: dict[str, Any], *, fastest: bool, progress: bool | Callable[[str, int, int], None]
) -> ScenarioFile:
    """Return a first scenario for a vehicle; `choice` are options of `scenario` that were given."""
    from quadsim.assets import vehicle_path
    from quadsim.console.progress import reporting
    from quadsim.features.design.any_course import course_for
    from quadsim.features.design.fastest import DEFAULT_MARGIN, at_fastest, fly_fastest
    from quadsim.features.design.first_scenario import first_scenario
    from quadsim.scenarios import loading
    from quadsim.scenarios.assembly import stated_disturbance
    from quadsim.vehicle import load_vehicle

    if "margin" in choice and not fastest:
        raise ParameterError("", "--margin", choice["margin"], "given with --fastest alone")
    path = vehicle_path(file)
    vehicle = load_vehicle(path)
    law = choice.get("controller", "robust")
    tilt = choice.get("tilt")
    course = course_for(choice.get("course", "hover"), vehicle, file, law=law, tilt=tilt, size=choice.get("size"))
    disturbance = stated_disturbance(path)
    first = first_scenario(vehicle, file, course=course, law=law, tilt=tilt, disturbance=disturbance)
    if fastest:
        margin = choice.get("margin", DEFAULT_MARGIN)
        with reporting(progress, "the flights") as report:
            fastest_course = fly_fastest(first.scenario, margin, report)
        first = at_fastest(first, fastest_course)
    return loading.ScenarioFile(first.to_toml())


def vehicle_report(
    name: VehicleName | None = None,
    /,
    *,
    template: Flag = False,
    thrust_stand: File | None = None,
    rotors: Whole | None = None,
    diameter: float | None = None,
    scenario: ScenarioName | None = None,
    out: File | None = None,
    overwrite: Flag = False,
) -> VehicleReport | Document:
    """Report a vehicle's limits and designed gains, and the sources of its parameters; draw it.

    Args:
        name: shipped vehicle's name, or path to a TOML file.
        template: print a commented vehicle file to fill in instead.
        thrust_stand: CSV table of a stand, as it is sold (rpm, speed or throttle; thrust; torque), or of a propeller's
            CT and CP by rpm: print the vehicle's file, or the template, with the numbers that it gives, and the fit.
        rotors: how many rotors the table of the stand is of, 1 or 4 (default: 1, where that leaves no doubt).
        diameter: of the propeller [m], for a table of CT and CP.
        scenario: scenario whose bounds the vehicle may be unable to meet; they are listed.
        out: PDF, SVG or PNG file for a drawing from above: numbers, spins, places and arms of the rotors, front, axes;
            with a stand, TOML file for the vehicle.
        overwrite: replace an existing file.

    Returns:
        The vehicle's parameters with their sources, the `figures` derived from them, and the `shortfalls` if a scenario
        is given; or the `content` of a vehicle file.

    Raises:
        InputError: the vehicle or scenario does not exist, the vehicle cannot fly, or the file has another ending.
        OutputError: the file exists, or cannot be written.

    Examples:
        >>> import quadsim
        >>> report = quadsim.vehicle_report("hummingbird", scenario="paper-constrained")
        >>> report.figures.designed.limited_by, round(report.figures.designed.time_constants["x, y"], 2)  # [s]
        ('torque', 0.18)
        >>> report.shortfalls[0]
        'controller.input_bounds.speed: hover is 453.2 rad/s, the scenario allows 250'
    """
    from quadsim.assets import vehicle_path
    from quadsim.console import results

    if thrust_stand is not None:
        for option, value in {"--template": template, "--scenario": scenario}.items():
            if value:
                raise ParameterError("", "--thrust-stand", str(thrust_stand), f"given without {option}")
        if name is None:
            start = _TEMPLATE
        else:
            start = vehicle_path(str(name))
        return _by_stand(Path(thrust_stand), start, rotors, diameter, out, overwrite=overwrite)
    for option, number in {"--rotors": rotors, "--diameter": diameter}.items():
        if number is not None:
            raise ParameterError("", option, number, "given with --thrust-stand alone")
    if template:
        return results.Document(_TEMPLATE.read_text(encoding="utf-8"))
    if name is None:
        names = ", ".join(vehicle_names())
        raise InputError(f"vehicle needs a name or a TOML file, or --template (there are: {names})")
    return _drawn_report(vehicle_path(str(name)), scenario, out, overwrite=overwrite)


def _drawn_report(path: Path, scenario: ScenarioName | None, out: File | None, *, overwrite: bool) -> VehicleReport:
    """Return the report of a vehicle's file, and draw the vehicle to `out`; see `vehicle_report`."""
    from quadsim.console import results
    from quadsim.features.design import shortfalls
    from quadsim.report import vehicle_drawing
    from quadsim.scenarios import loading
    from quadsim.vehicle import load_vehicle

    vehicle = load_vehicle(path)
    compared = None
    if scenario is not None:
        compared = loading.load_scenario(scenario)
    picture = None
    if out is not None:
        picture = vehicle_drawing.drawing_file(out, overwrite=overwrite)
    report = _report_on(path, vehicle)
    if compared is not None:
        missed = shortfalls.shortfalls(compared, vehicle)
        report = replace(report, scenario=compared.name, shortfalls=missed)
    if picture is None:
        return report
    with results.after(report, picture):
        vehicle_drawing.write_drawing(vehicle, picture, overwrite=overwrite)
    return replace(report, picture=picture)


def _report_on(path: Path, vehicle: Vehicle) -> VehicleReport:
    """Return the report on a vehicle and its file, compared with no scenario."""
    from quadsim.features.design import vehicle_report
    from quadsim.scenarios.assembly import stated_autopilot
    from quadsim.sim.autopilot import AutopilotSettings
    from quadsim.vehicle import example_notes, vehicle_sources

    settings = stated_autopilot(path) or AutopilotSettings()
    autopilot = settings.resolved(vehicle)
    return vehicle_report.VehicleReport(
        vehicle=vehicle,
        sources=vehicle_sources(path),
        leftovers=example_notes(path),
        autopilot=autopilot,
        inner_lag=vehicle_report.inner_lag_of(vehicle, autopilot),
        figures=vehicle_report.make_sheet(vehicle),
    )


def _by_stand(
    stand: Path, start: Path, rotors: int | None, diameter: float | None, out: File | None, *, overwrite: bool
) -> Document:
    """Return the vehicle file of a thrust stand, and write it to `out`; see `vehicle_report`."""
    from quadsim.console import results
    from quadsim.features.design.thrust_stand import stand_vehicle_text
    from quadsim.outputs import require_file, writing_file
    from quadsim.vehicle import N_ROTORS, load_vehicle

    if rotors not in {None, 1, N_ROTORS}:
        raise ParameterError("", "--rotors", rotors, f"1 or {N_ROTORS}")
    if diameter is not None and not 0.0 < diameter < math.inf:
        raise ParameterError("", "--diameter", diameter, "above 0, in m")
    if start.name != _TEMPLATE.name:
        load_vehicle(start)
    if out is not None and Path(out).suffix != ".toml":
        raise ParameterError("", "--out", str(out), "a .toml file with --thrust-stand")
    if out is None:
        target = None
    else:
        target = require_file(out, overwrite=overwrite)
    text, numbers = stand_vehicle_text(stand, start.read_text(encoding="utf-8-sig"), rotors=rotors, diameter=diameter)
    if target is None:
        return results.Document(text, numbers)
    with writing_file(target, overwrite=overwrite) as new:
        new.write_text(text, encoding="utf-8")
    notes = "".join(f"{note}\n" for note in numbers["notes"])
    return results.Document(f"written to {target}\n{notes}", numbers)
