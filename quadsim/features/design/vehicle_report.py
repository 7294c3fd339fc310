"""Report of a vehicle: hover, reserves, the linear model and the control that it permits, as tables.

`make_sheet` derives the figures: reserves by `authority.py`, poles of the model at hover x' = A_c x + B_c u, and the
controller that `rules.py` designs.  `VehicleReport` is what `quadsim vehicle` returns; `vehicle_tables` shows it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from quadsim.console.results import Shown, Tabular
from quadsim.errors import ParameterError, QuadsimError
from quadsim.features.design.authority import TorqueRange, control_authority, torque_ranges
from quadsim.features.design.rules import delay_margin, design_for
from quadsim.mpc.problem.model import continuous_model, discretise
from quadsim.plausibility import implausible
from quadsim.report import vehicle_drawing
from quadsim.report.figure import Figure
from quadsim.report.table import Cell, Grid, format_number
from quadsim.sim.autopilot import AutopilotSettings, built_in_lags
from quadsim.state import INDEX
from quadsim.vehicle import N_ROTORS, VEHICLE_UNITS, Vehicle

SHEET_PERIOD: Final = 0.05  # control period of the discrete poles [s], the paper's
TIMESTEP: Final = 1e-3  # of the physics behind the autopilot's lags [s]
CHAINS: Final = (4, 4, 2, 2)  # of integrators in the model at hover: x over pitch, y over roll, z, yaw
_RPM: Final = 60.0 / (2.0 * math.pi)


@dataclass(frozen=True, kw_only=True)
class Designed:
    """Performance of a controller designed for a vehicle; see `quadsim.features.design.rules`."""

    time_constants: dict[str, float]  # one over the bandwidth of each axis [s]
    limited_by: str  # what keeps the bandwidth of x and y from being larger: lag, torque or period
    tilt_bound: float  # [deg]
    level_acceleration: float  # largest within it [m/s^2]
    level_speed: float | None  # at which the air increases a tilt as fast as the loop answers [m/s]; None: at none
    period: float  # control period [s]
    delay_margin: float  # delay beyond the modelled one that its loop tolerates, without active bounds [s]


@dataclass(frozen=True, kw_only=True)
class VehicleSheet:
    """Figures derived from a vehicle's parameters, all at hover."""

    weight: float  # m g [N]
    hover_speed: float  # omega_bar [rad/s]
    hover_speed_rpm: float  # the same [rpm]
    hover_speeds: tuple[float, ...]  # of each rotor, the trim [rad/s]
    speed_range_used: float  # where hover lies between the lowest speed, 0, and the highest, 1 [-]
    thrust_to_weight: float  # all rotors at their highest speed, over the weight [-]
    climb_acceleration: float  # largest upward acceleration from hover, level [m/s^2]
    steady_tilt: float
    """Largest tilt at which the rotors still carry the weight, cos(tilt) = 1 / thrust_to_weight [deg]."""
    torques: tuple[TorqueRange, ...]  # about x, y and z
    thrust_slope: float  # of one rotor at hover, 2 b omega_bar, or a1 + 2 a2 omega_bar [N s/rad]
    input_slopes: dict[str, float]
    """Largest entry of B_c in the rows of vz [m/s^2 per rad/s] and of the three rates [rad/s^2 per rad/s]: the modelled
    effect of one rotor per rad/s."""
    integrator_chains: tuple[int, ...]
    """Lengths of the chains of integrators that the linear model falls into, longest first."""
    continuous_poles: tuple[float, ...]  # of A_c [1/s]
    discrete_poles: tuple[float, ...]  # of A at `period` [-]
    period: float  # tau_s [s]
    lag_poles: dict[str, float]
    """Of the rotors' speeds when they rise and fall, continuous [1/s], as far as the file gives them."""
    discrete_lag_poles: dict[str, float]  # the same at `period` [-]
    sink_acceleration: float  # largest downward acceleration from hover, level [m/s^2]
    designed: Designed | None  # None where hover leaves nothing to control it with


@dataclass(frozen=True, kw_only=True)
class VehicleReport(Tabular):
    """A vehicle with its derived figures."""

    vehicle: Vehicle  # its numbers
    sources: Mapping[str, str]  # of each parameter, as its file names them
    figures: VehicleSheet  # what follows from the numbers
    autopilot: AutopilotSettings  # of its file, what is absent by rule
    inner_lag: tuple[float, ...] | str
    """First-order lags of thrust, p, q, r under the autopilot [s], or why none can be identified."""
    scenario: str | None = None  # scenario that it was compared with, or None
    shortfalls: tuple[str, ...] | None = None
    """Bounds of that scenario that it cannot meet, a sentence each; None without a scenario."""
    leftovers: tuple[str, ...] = ()  # what its file still has of the template's example, a sentence each
    picture: Path | None = None  # where it was drawn to, or None

    @property
    def parameters(self) -> list[tuple[str, Any, str]]:
        """Name, value and unit of the parameters in the file."""
        rows = []
        for name, unit in VEHICLE_UNITS.items():
            value = getattr(self.vehicle, name)
            if value is not None:
                rows.append((name, value, unit))
        return rows

    @property
    def notes(self) -> list[str]:
        """What is doubtful: leftovers of an example, and numbers that no quadrotor has together."""
        return [*self.leftovers, *implausible(self.vehicle)]

    def shown(self) -> Shown:
        """See `Result.shown`."""
        from quadsim.console import console

        yield from console.grids(vehicle_tables(self), left=("unit", "source", "what and why"))
        yield from self.notes
        if self.picture is not None:
            yield console.written_to(self.picture)

    def records(self) -> list[dict[str, Any]]:
        """Return a row per parameter of the file: its value, unit and source."""
        rows = []
        for name, value, unit in self.parameters:
            rows.append({"parameter": name, "value": value, "unit": unit, "source": self.sources[name]})
        return rows

    def small_plot(self) -> Figure:
        """See `Result.small_plot`."""
        return vehicle_drawing.vehicle_figure(self.vehicle)

    def to_json(self) -> dict[str, Any]:
        """All of it as plain values: the vehicle, each parameter with unit and source, and what follows from them."""
        parameters = {}
        for name, value, unit in self.parameters:
            parameters[name] = {"value": value, "unit": unit, "source": self.sources[name]}
        autopilot = asdict(self.autopilot)
        if isinstance(self.inner_lag, str):
            autopilot["inner_lag"] = None
            autopilot["why"] = self.inner_lag
        else:
            autopilot["inner_lag"] = self.inner_lag
        data: dict[str, Any] = {
            "name": self.vehicle.name,
            "description": self.vehicle.description,
            "parameters": parameters,
            "derived": asdict(self.figures),
            "notes": self.notes,
            "autopilot": autopilot,
        }
        if self.shortfalls is not None:
            data |= {"scenario": self.scenario, "shortfalls": self.shortfalls}
        return data


def inner_lag_of(vehicle: Vehicle, autopilot: AutopilotSettings) -> tuple[float, ...] | str:
    """Return `inner_lag` of the report: controllers that command the rotors fly without one."""
    try:
        return built_in_lags(vehicle, autopilot, TIMESTEP)
    except QuadsimError as error:
        return str(error)


def make_sheet(vehicle: Vehicle) -> VehicleSheet:
    """Return the figures of a vehicle."""
    A_c, B_c = continuous_model(vehicle)
    A, _ = discretise(A_c, B_c, SHEET_PERIOD)
    authority = control_authority(vehicle)
    input_slopes = {}
    for name in ("vz", "roll_rate", "pitch_rate", "yaw_rate"):
        input_slopes[name] = float(np.abs(B_c[INDEX[name]]).max())
    lag_poles = {}
    discrete_lag_poles = {}
    for name in ("rotor_rise", "rotor_fall"):
        time_constant = getattr(vehicle, name)
        if time_constant is not None:
            lag_poles[name] = -1.0 / time_constant
            discrete_lag_poles[name] = math.exp(-SHEET_PERIOD / time_constant)
    return VehicleSheet(
        weight=vehicle.mass * vehicle.gravity,
        hover_speed=vehicle.hover_speed,
        hover_speed_rpm=_RPM * vehicle.hover_speed,
        hover_speeds=tuple(vehicle.hover_speeds.tolist()),
        speed_range_used=authority.hover_share,
        thrust_to_weight=authority.thrust_to_weight,
        climb_acceleration=authority.climb,
        steady_tilt=math.degrees(authority.steady_tilt),
        torques=torque_ranges(vehicle),
        thrust_slope=2.0 * vehicle.mean_coefficient * vehicle.hover_speed - vehicle.thrust_law[0],
        input_slopes=input_slopes,
        integrator_chains=CHAINS,
        # A_c permutes to a strictly upper triangular matrix: chains of integrators, whose poles are its diagonal.
        continuous_poles=tuple(np.diag(A_c).tolist()),
        discrete_poles=tuple(np.diag(A).tolist()),
        period=SHEET_PERIOD,
        lag_poles=lag_poles,
        discrete_lag_poles=discrete_lag_poles,
        sink_acceleration=authority.sink,
        designed=_designed(vehicle),
    )


def _designed(vehicle: Vehicle) -> Designed | None:
    """Return what a controller designed for a vehicle achieves; None where hover leaves nothing to control it with."""
    try:
        design = design_for(vehicle)
    except ParameterError:
        return None
    level_speed = None
    if math.isfinite(design.fastest):
        level_speed = design.fastest
    return Designed(
        time_constants={"x, y": 1.0 / design.bandwidth, "z": 1.0 / design.height, "yaw": 1.0 / design.heading},
        limited_by=design.limited_by,
        tilt_bound=math.degrees(design.tilt),
        level_acceleration=vehicle.gravity * design.acceleration,
        level_speed=level_speed,
        period=design.period,
        delay_margin=delay_margin(vehicle, design),
    )


def vehicle_tables(report: VehicleReport) -> list[Grid]:
    """Return all of it as tables: figures, torques, control, autopilot, linear model, parameters, shortfalls."""
    vehicle = report.vehicle
    sheet = report.figures
    tables = [
        _grid(f"{vehicle.name} at hover", ("", "value", "unit"), _figures(vehicle, sheet), note=vehicle.description),
        _grid(
            "torque authority at hover",
            ("axis", "torque [N m]", "acceleration [rad/s^2]", "pure torque [N m]"),
            _torques(sheet),
            note="thrust held at the weight, every rotor within its range; pure: no torque about the other axes",
        ),
        _grid(
            "what a controller made for it can do",
            ("", "value", "unit"),
            _achievable(sheet),
            note="quadsim scenario --for VEHICLE makes it; the rules: quadsim/features/design/rules.py",
        ),
        _grid(
            "its autopilot, for controllers of thrust and body rates",
            ("", "value", "unit"),
            _autopilot(report),
            note="gains by rule where its file states none; lags by steps from hover",
        ),
        _grid("linear model at hover", ("", "continuous [1/s]", f"discrete, {1e3 * sheet.period:g} ms"), _poles(sheet)),
        _grid(
            "parameters",
            ("parameter", "value", "unit", "source"),
            _parameters(report),
            note="the vehicle file's header expands the source abbreviations",
        ),
    ]
    if report.shortfalls is not None:
        lines = [(str(i), text) for i, text in enumerate(report.shortfalls, start=1)]
        if not lines:
            lines = [("-", "none: the vehicle meets all of them")]
        tables.append(_grid(f"bounds of {report.scenario} that it cannot meet", ("", "what and why"), lines))
    return tables


def _figures(vehicle: Vehicle, sheet: VehicleSheet) -> list[tuple[str, ...]]:
    """Return lines of the figures at hover; the rotors' speeds one by one where they differ."""
    lines: list[tuple[str, ...]] = [
        ("mass", format_number(vehicle.mass), "kg"),
        ("weight", format_number(sheet.weight), "N"),
        ("hover speed", format_number(sheet.hover_speed), "rad/s"),
        ("", format_number(sheet.hover_speed_rpm), "rpm"),
    ]
    if len(set(sheet.hover_speeds)) > 1:
        for i, speed in enumerate(sheet.hover_speeds, start=1):
            lines.append((f"of rotor {i}", format_number(speed), "rad/s"))
    slopes = sheet.input_slopes
    lines += [
        ("speed range used", f"{100.0 * sheet.speed_range_used:.1f}", "%"),
        ("thrust to weight", format_number(sheet.thrust_to_weight), "-"),
        ("largest climb acceleration", format_number(sheet.climb_acceleration), "m/s^2"),
        ("largest steady tilt", format_number(sheet.steady_tilt), "deg"),
        ("thrust of one rotor per rad/s", format_number(sheet.thrust_slope), "N s/rad"),
        ("climb per rad/s of one rotor, as modelled", format_number(slopes["vz"]), "m/s^2 per rad/s"),
    ]
    for name in ("roll", "pitch", "yaw"):
        label = f"{name} per rad/s of one rotor, as modelled"
        lines.append((label, format_number(slopes[f"{name}_rate"]), "rad/s^2 per rad/s"))
    return lines


def _torques(sheet: VehicleSheet) -> list[tuple[str, str, str, str]]:
    """Return a line per axis: the ranges of torque, of angular acceleration and of pure torque."""
    lines = []
    for torque in sheet.torques:
        torques = _range(torque.lowest, torque.highest)
        accelerations = _range(torque.lowest_acceleration, torque.highest_acceleration)
        pure_torques = _range(torque.lowest_pure, torque.highest_pure)
        lines.append((torque.axis, torques, accelerations, pure_torques))
    return lines


def _range(lowest: float, highest: float) -> str:
    return f"{format_number(lowest)} .. {format_number(highest)}"


def _achievable(sheet: VehicleSheet) -> list[tuple[str, ...]]:
    """Return lines of what a controller designed for the vehicle achieves."""
    sink = ("largest sink acceleration", format_number(sheet.sink_acceleration), "m/s^2")
    designed = sheet.designed
    if designed is None:
        return [sink, ("none can be made: hover leaves nothing to control it with", "-", "")]
    if designed.level_speed is None:
        level_speed = "none"
        unit = ""
    else:
        level_speed = format_number(designed.level_speed)
        unit = "m/s"
    lines: list[tuple[str, ...]] = [
        sink,
        ("tilt bound", format_number(designed.tilt_bound), "deg"),
        ("largest level acceleration within it", format_number(designed.level_acceleration), "m/s^2"),
        ("level speed at which aerodynamic moments overturn it", level_speed, unit),
    ]
    limits = {"lag": "the rotors' lag", "torque": "torque in reserve", "period": "the shortest control period"}
    for axes, time in designed.time_constants.items():
        label = f"time constant of {axes}"
        if axes == "x, y":
            label += f", limited by {limits[designed.limited_by]}"
        lines.append((label, format_number(time), "s"))
    lines += [
        ("additional delay that the loop tolerates", format_number(designed.delay_margin), "s"),
        ("control period", format_number(designed.period), "s"),
    ]
    return lines


def _autopilot(report: VehicleReport) -> list[tuple[str, ...]]:
    """Return lines of the autopilot's gains, its rate, and the lags under it."""
    settings = report.autopilot
    gains = {"p": "1/s", "i": "1/s^2", "d": "-", "i_max": "rad/s^2", "attitude": "1/s"}
    lines: list[tuple[str, ...]] = []
    for name, unit in gains.items():
        lines.append((f"{name}, roll, pitch, yaw", _listed(getattr(settings, name)), unit))
    lines.append(("rate", format_number(settings.rate or 0.0), "Hz"))
    label = "inner_lag, thrust, roll, pitch, yaw"
    if isinstance(report.inner_lag, str):
        lines.append((label, "none", report.inner_lag))
    else:
        lines.append((label, _listed(report.inner_lag), "s"))
    return lines


def _listed(numbers: Sequence[float]) -> str:
    return ", ".join(f"{number:.3g}" for number in numbers)


def _poles(sheet: VehicleSheet) -> list[tuple[str, str, str]]:
    """Return lines of the poles, continuous and discrete, of the rigid body and of the rotors' lags."""
    chains = ", ".join(map(str, sheet.integrator_chains))
    lines = [(f"rigid body: {len(sheet.continuous_poles)} poles, chains of {chains} integrators", "0", "1")]
    for name, pole in sheet.lag_poles.items():
        label = f"rotors that {name.removeprefix('rotor_')}: {N_ROTORS} poles, not in this model"
        lines.append((label, format_number(pole), format_number(sheet.discrete_lag_poles[name])))
    return lines


def _parameters(report: VehicleReport) -> list[tuple[str, str, str, str]]:
    """Return a line per parameter of the file: its name, value, unit and source."""
    lines = []
    for name, value, unit in report.parameters:
        numbers = ", ".join(f"{number:g}" for number in np.ravel(value))
        lines.append((name, numbers, unit, report.sources[name]))
    return lines


def _grid(title: str, head: tuple[str, ...], lines: Sequence[tuple[str, ...]], note: str = "") -> Grid:
    rows = []
    for line in lines:
        rows.append(tuple(Cell(text=text) for text in line))
    return Grid(key=head[0], title=title, head=head, lines=tuple(rows), note=note)
