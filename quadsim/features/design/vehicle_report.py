"""Report of a vehicle: hover, margins, the linear model and achievable control, as tables."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from quadsim.console.results import Shown, Tabular
from quadsim.errors import ParameterError, QuadsimError
from quadsim.features.design.authority import TorqueRange, authority, torque_ranges
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
    limited_by: str  # what the bandwidth of x and y is the limit of: lag, torque or period
    tilt_bound: float  # [deg]
    level_acceleration: float  # largest within it [m/s^2]
    level_speed: float | None  # at which the air tilts the body on as fast as the loop answers [m/s]; None: at none
    period: float  # control period [s]
    delay_margin: float  # delay beyond what the model knows of that its loop stands, without bounds [s]


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
    # largest tilt at which the rotors still carry the weight, cos(tilt) = 1 / thrust_to_weight [deg]
    steady_tilt: float
    torques: tuple[TorqueRange, ...]  # about x, y and z
    thrust_slope: float  # of one rotor at hover, 2 b omega_bar, or a1 + 2 a2 omega_bar [N s/rad]
    # largest entry of B_c in the rows of vz [m/s^2 per rad/s] and of the three rates [rad/s^2 per rad/s]: the modelled
    # effect of one rotor per rad/s
    input_slopes: dict[str, float]
    # lengths of the chains of integrators that the linear model falls into, longest first
    integrator_chains: tuple[int, ...]
    continuous_poles: tuple[float, ...]  # of A_c [1/s]
    discrete_poles: tuple[float, ...]  # of A at `period` [-]
    period: float  # tau_s [s]
    # of the rotors' speeds when they rise and fall, continuous [1/s], as far as the file gives them
    lag_poles: dict[str, float]
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
    inner_lag: (
        tuple[float, ...] | str
    )  # first-order lags of thrust, p, q, r under it [s], or why none can be identified
    scenario: str | None = None  # scenario that it was compared with, or None
    shortfalls: tuple[str, ...] | None = None
    """Bounds of that scenario that it cannot meet, a sentence each; None without a scenario."""
    leftovers: tuple[str, ...] = ()  # what its file still has of the template's example, a sentence each
    picture: Path | None = None  # where it was drawn to, or None

    @property
    def parameters(self) -> list[tuple[str, Any, str]]:
        """Name, value and unit of the parameters in the file."""
        values = ((name, getattr(self.vehicle, name), unit) for name, unit in VEHICLE_UNITS.items())
        return [(name, value, unit) for name, value, unit in values if value is not None]

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
        data: dict[str, Any] = {
            "name": self.vehicle.name,
            "description": self.vehicle.description,
            "parameters": {
                name: {"value": value, "unit": unit, "source": self.sources[name]}
                for name, value, unit in self.parameters
            },
            "derived": asdict(self.figures),
            "notes": self.notes,
            "autopilot": {
                **asdict(self.autopilot),
                **({"inner_lag": None, "why": lag} if isinstance(lag := self.inner_lag, str) else {"inner_lag": lag}),
            },
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
    """The figures of a vehicle."""
    A_c, B_c = continuous_model(vehicle)
    A, _ = discretise(A_c, B_c, SHEET_PERIOD)
    can = authority(vehicle)
    lags = {name: value for name in ("rotor_rise", "rotor_fall") if (value := getattr(vehicle, name)) is not None}
    return VehicleSheet(
        weight=vehicle.mass * vehicle.gravity,
        hover_speed=vehicle.hover_speed,
        hover_speed_rpm=_RPM * vehicle.hover_speed,
        hover_speeds=tuple(vehicle.hover_speeds.tolist()),
        speed_range_used=can.hover_share,
        thrust_to_weight=can.thrust_to_weight,
        climb_acceleration=can.climb,
        steady_tilt=math.degrees(can.steady_tilt),
        torques=torque_ranges(vehicle),
        thrust_slope=2.0 * vehicle.mean_coefficient * vehicle.hover_speed - vehicle.thrust_law[0],
        input_slopes={
            name: float(np.abs(B_c[INDEX[name]]).max()) for name in ("vz", "roll_rate", "pitch_rate", "yaw_rate")
        },
        integrator_chains=CHAINS,
        # A_c permutes to a strictly upper triangular matrix: chains of integrators, whose poles are its diagonal.
        continuous_poles=tuple(np.diag(A_c).tolist()),
        discrete_poles=tuple(np.diag(A).tolist()),
        period=SHEET_PERIOD,
        lag_poles={name: -1.0 / value for name, value in lags.items()},
        discrete_lag_poles={name: math.exp(-SHEET_PERIOD / value) for name, value in lags.items()},
        sink_acceleration=can.sink,
        designed=_designed(vehicle),
    )


def _designed(vehicle: Vehicle) -> Designed | None:
    try:
        tuning = design_for(vehicle)
    except ParameterError:
        return None
    return Designed(
        time_constants={"x, y": 1.0 / tuning.bandwidth, "z": 1.0 / tuning.height, "yaw": 1.0 / tuning.heading},
        limited_by=tuning.limited_by,
        tilt_bound=math.degrees(tuning.tilt),
        level_acceleration=vehicle.gravity * tuning.acceleration,
        level_speed=tuning.fastest if math.isfinite(tuning.fastest) else None,
        period=tuning.period,
        delay_margin=delay_margin(vehicle, tuning),
    )


def _trim(sheet: VehicleSheet) -> list[tuple[int, float]]:
    """Return the number of each rotor and its speed in hover; nothing where all are alike."""
    speeds = sheet.hover_speeds
    if len({*speeds}) == 1:
        return []
    return list(enumerate(speeds, start=1))


def vehicle_tables(report: VehicleReport) -> list[Grid]:
    """All of it as tables: figures, torques, what a controller can do, linear model, parameters, shortfalls."""
    vehicle = report.vehicle
    sheet = report.figures
    spans = []
    for torque in sheet.torques:
        spans.append(
            (torque.axis, *(f"{format_number(low)} .. {format_number(high)}" for low, high in _ranges(torque)))
        )
    tables = [
        _grid(f"{vehicle.name} at hover", ("", "value", "unit"), _figures(vehicle, sheet), note=vehicle.description),
        _grid(
            "torque authority at hover",
            ("axis", "torque [N m]", "acceleration [rad/s^2]", "pure torque [N m]"),
            spans,
            note="thrust held at the weight, every rotor within its range; pure: no torque about the other axes",
        ),
        _grid(
            "what a controller made for it can do",
            ("", "value", "unit"),
            _abilities(sheet),
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
            [
                (name, ", ".join(f"{number:g}" for number in np.ravel(value)), unit, report.sources[name])
                for name, value, unit in report.parameters
            ],
            note="the vehicle file's header expands the source abbreviations",
        ),
    ]
    if report.shortfalls is not None:
        lines = [(str(i), text) for i, text in enumerate(report.shortfalls, start=1)]
        none = [("-", "none: the vehicle meets all of them")]
        tables.append(_grid(f"bounds of {report.scenario} that it cannot meet", ("", "what and why"), lines or none))
    return tables


def _ranges(torque: TorqueRange) -> tuple[tuple[float, float], ...]:
    kinds = ("", "_acceleration", "_pure")
    return tuple((getattr(torque, f"lowest{kind}"), getattr(torque, f"highest{kind}")) for kind in kinds)


def _figures(vehicle: Vehicle, sheet: VehicleSheet) -> list[tuple[str, ...]]:
    slopes = sheet.input_slopes
    return [
        ("mass", format_number(vehicle.mass), "kg"),
        ("weight", format_number(sheet.weight), "N"),
        ("hover speed", format_number(sheet.hover_speed), "rad/s"),
        ("", format_number(sheet.hover_speed_rpm), "rpm"),
        *((f"of rotor {i}", format_number(speed), "rad/s") for i, speed in _trim(sheet)),
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
    if made.level_speed is None:
        speed = ("none", "")
    else:
        speed = (format_number(made.level_speed), "m/s")
    labels = {"x, y": f"x, y, limited by {why[made.limited_by]}"}
    return [
        sinks,
        ("tilt bound", format_number(made.tilt_bound), "deg"),
        ("largest level acceleration within it", format_number(made.level_acceleration), "m/s^2"),
        ("level speed at which aerodynamic moments overturn it", *speed),
        *(
            (f"time constant of {labels.get(axis, axis)}", format_number(time), "s")
            for axis, time in made.time_constants.items()
        ),
        ("additional delay that the loop tolerates", format_number(made.delay_margin), "s"),
        ("control period", format_number(made.period), "s"),
    ]


def _autopilot(report: VehicleReport) -> list[tuple[str, ...]]:
    settings = report.autopilot
    gains = {"p": "1/s", "i": "1/s^2", "d": "-", "i_max": "rad/s^2", "attitude": "1/s"}
    return [
        *((f"{name}, roll, pitch, yaw", _listed(getattr(settings, name)), unit) for name, unit in gains.items()),
        ("rate", format_number(settings.rate or 0.0), "Hz"),
        (
            "inner_lag, thrust, roll, pitch, yaw",
            *(("none", report.inner_lag) if isinstance(report.inner_lag, str) else (_listed(report.inner_lag), "s")),
        ),
    ]


def _listed(numbers: Sequence[float]) -> str:
    return ", ".join(f"{number:.3g}" for number in numbers)


def _poles(sheet: VehicleSheet) -> list[tuple[str, ...]]:
    chains = ", ".join(map(str, sheet.integrator_chains))
    body = f"rigid body: {len(sheet.continuous_poles)} poles, chains of {chains} integrators"
    lags = []
    for name, pole in sheet.lag_poles.items():
        lags.append(
            (f"rotors that {name.removeprefix('rotor_')}: {N_ROTORS} poles, not in this model", format_number(pole))
        )
    discrete = map(format_number, sheet.discrete_lag_poles.values())
    return [(body, "0", "1"), *((*lag, pole) for lag, pole in zip(lags, discrete, strict=True))]


def _grid(title: str, head: tuple[str, ...], lines: Sequence[tuple[str, ...]], note: str = "") -> Grid:
    cells = tuple(tuple(Cell(text=text) for text in line) for line in lines)
    return Grid(key=head[0], title=title, head=head, lines=cells, note=note)
