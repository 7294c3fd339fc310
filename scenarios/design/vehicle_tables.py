"""What the numbers of a vehicle amount to, as tables."""

from __future__ import annotations

from collections.abc import Sequence

from quadsim.report.table import Cell, Grid, format_number
from quadsim.vehicle import N_ROTORS, Vehicle
from scenarios.design.vehicle_figures import VehicleReport, VehicleSheet


def vehicle_tables(report: VehicleReport) -> list[Grid]:
    """All of it as tables: figures, torques, what a controller can do, linear model, parameters, shortfalls."""
    vehicle, sheet, sources = report.vehicle, report.figures, report.sources
    tables = [
        _grid(f"{vehicle.name} at hover", ("", "value", "unit"), _figures(vehicle, sheet), note=vehicle.description),
        _grid(
            "torque authority at hover",
            ("axis", "torque [N m]", "acceleration [rad/s^2]", "pure torque [N m]"),
            [
                (
                    torque.axis,
                    _span(torque.lowest, torque.highest),
                    _span(torque.lowest_acceleration, torque.highest_acceleration),
                    _span(torque.lowest_pure, torque.highest_pure),
                )
                for torque in sheet.torques
            ],
            note="thrust held at the weight, every rotor within its range; pure: no torque about the other axes",
        ),
        _grid(
            "what a controller made for it can do",
            ("", "value", "unit"),
            _abilities(sheet),
            note="quadsim scenario --for VEHICLE makes it; the rules: scenarios/design/rules.py",
        ),
        _grid("linear model at hover", ("", "continuous [1/s]", f"discrete, {1e3 * sheet.period:g} ms"), _poles(sheet)),
        _grid(
            "parameters",
            ("parameter", "value", "unit", "source"),
            [(name, _value(value), unit, sources[name]) for name, value, unit in report.parameters],
            note="short names of sources are spelt out at the head of the vehicle's file",
        ),
    ]
    return tables if report.shortfalls is None else [*tables, _shortfalls(report.scenario or "", report.shortfalls)]


def _shortfalls(scenario: str, missed: Sequence[str]) -> Grid:
    lines = [(str(i + 1), text) for i, text in enumerate(missed)] or [("-", "none: the vehicle meets all of them")]
    return _grid(f"bounds of {scenario} that it cannot meet", ("", "what and why"), lines)


def _figures(vehicle: Vehicle, sheet: VehicleSheet) -> list[tuple[str, ...]]:
    slopes = sheet.input_slopes
    return [
        ("mass", format_number(vehicle.mass), "kg"),
        ("weight", format_number(sheet.weight), "N"),
        ("hover speed", format_number(sheet.hover_speed), "rad/s"),
        ("", format_number(sheet.hover_speed_rpm), "rpm"),
        ("speed range used", f"{100.0 * sheet.speed_range_used:.1f}", "%"),
        ("thrust to weight", format_number(sheet.thrust_to_weight), "-"),
        ("largest climb acceleration", format_number(sheet.climb_acceleration), "m/s^2"),
        ("largest steady tilt", format_number(sheet.steady_tilt), "deg"),
        ("thrust of one rotor per rad/s", format_number(sheet.thrust_slope), "N s/rad"),
        ("climb per rad/s of one rotor, as modelled", format_number(slopes["vz"]), "m/s^2 per rad/s"),
        *(
            (f"{name} per rad/s of one rotor, as modelled", format_number(slopes[f"{name}_rate"]), "rad/s^2 per rad/s")
            for name in ("roll", "pitch", "yaw")
        ),
    ]


def _abilities(sheet: VehicleSheet) -> list[tuple[str, ...]]:
    sinks: tuple[str, ...] = ("largest sink acceleration", format_number(sheet.sink_acceleration), "m/s^2")
    made = sheet.designed
    if made is None:
        return [sinks, ("none can be made: hover leaves nothing to control it with", "-", "")]
    why = {"lag": "the rotors' lag", "torque": "torque in reserve", "period": "the shortest control period"}
    speed = "none" if made.level_speed is None else format_number(made.level_speed)
    labels = {"x, y": f"x, y, limited by {why[made.limited_by]}"}
    return [
        sinks,
        ("tilt bound", format_number(made.tilt_bound), "deg"),
        ("largest level acceleration within it", format_number(made.level_acceleration), "m/s^2"),
        ("level speed at which the air turns it over", speed, "m/s" if made.level_speed is not None else ""),
        *(
            (f"time constant of {labels.get(axis, axis)}", format_number(time), "s")
            for axis, time in made.time_constants.items()
        ),
        ("delay that it stands beyond what it knows of", format_number(made.delay_margin), "s"),
        ("control period", format_number(made.period), "s"),
    ]


def _poles(sheet: VehicleSheet) -> list[tuple[str, ...]]:
    chains = ", ".join(str(length) for length in sheet.integrator_chains)
    body = f"rigid body: {len(sheet.continuous_poles)} poles, chains of {chains} integrators"
    lines: list[tuple[str, ...]] = [(body, "0", "1")]
    for name, pole in sheet.lag_poles.items():
        label = f"rotors that {'rise' if name == 'rotor_rise' else 'fall'}: {N_ROTORS} poles, not in this model"
        lines.append((label, format_number(pole), format_number(sheet.discrete_lag_poles[name])))
    return lines


def _grid(title: str, head: tuple[str, ...], lines: Sequence[tuple[str, ...]], note: str = "") -> Grid:
    cells = tuple(tuple(Cell(text=text) for text in line) for line in lines)
    return Grid(key=head[0], title=title, head=head, lines=cells, note=note)


def _span(low: float, high: float) -> str:
    return f"{format_number(low)} .. {format_number(high)}"


def _value(value: object) -> str:
    return ", ".join(f"{item:g}" for item in value) if isinstance(value, tuple) else f"{value:g}"
