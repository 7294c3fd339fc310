"""`quadsim bench speed`: how well each controller follows an agile course, flown ever faster.

A flight is judged by its mean position error, and by how long roll or pitch is beyond a bound within which the course
can be flown.  Weights of the MPCs that are linearised at hover come from `scenarios.design.first_scenario`, those of
all other controllers are their defaults.
"""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

import numpy as np
from scipy.special import stdtrit

from quadsim.assets import vehicle_path
from quadsim.errors import ParameterError
from quadsim.flight import metrics
from quadsim.report.table import ABSENT, Cell, Grid, Mark, line
from quadsim.state import INDEX, tilt
from quadsim.vehicle import Vehicle, load_vehicle
from scenarios.courses.feasibility_check import report
from scenarios.design.first_scenario import first_scenario
from scenarios.loading import parse_scenario
from scenarios.many import answers
from scenarios.progress import Progress, silent
from scenarios.run import fly_scenario

Table = dict[str, Any]

ROOM: Final = 10.0
"""[deg] by which the bound on tilt is above what the course takes without drag."""
STEEPEST: Final = 80.0
"""[deg] largest bound: the most that the baselines may be given."""
TOLERANCE: Final = 0.5
"""[deg] beyond the bound that is no violation."""
NEAR: Final = 0.25
"""[m] mean error up to which a course counts as followed."""
SEEDS: Final = 5
"""Flights of each controller at each speed where the world is random."""
CONFIDENCE: Final = 0.95
NODE: Final = 0.1
"""[s] from node to node of the nonlinear MPC at most, as Torrente et al. (2021) have it."""
QUICK_WORLD, QUICK_SPEEDS, QUICK_LAWS = "loop, drag", (4.0, 6.0), ("LQR", "nonlinear")


@dataclass(frozen=True, kw_only=True)
class World:
    """A vehicle on a course, at several speeds."""

    about: str  # what it is, for a person
    vehicle: str  # its name
    size: float  # of the course [m]; a vehicle farther off is lost
    speeds: tuple[float, ...]  # to fly at [m/s]
    course: Callable[[float, float], tuple[Table, float]]  # `[reference]` and duration [s] at a speed, for a period [s]
    changes: Table  # of the vehicle's first scenario, whose plant has lag, inertia and drag of the vehicle's file
    seeds: int = 1  # flights at each speed; 1 where nothing is random


def _loop(speed: float, period: float) -> tuple[Table, float]:
    reference = {"type": "ramped_circle", "radius": 5.0, "acceleration": 2.0, "ramp": 1.0, "heading": "held"}
    return {**reference, "speed": speed, "sampling": period}, speed + 2.0


def _eight(speed: float, period: float) -> tuple[Table, float]:
    length = 4.0
    turn = math.tau * math.sqrt(0.5) * length / speed
    reference = {"type": "figure_eight", "length": length, "speed": speed, "turns": 2.0, "ramp": turn, "start": 0.5}
    return reference, period * math.ceil((0.5 + 3.0 * turn) / period)


_PLANT: Final = {"timestep": 0.0005, "integrator": "rk4", "limit_speeds": True}
_DRAG: Final = {"air": {"linear_drag": [0.3, 0.3, 0.0], "quadratic_drag": [0.08, 0.08, 0.08]}}
_SENSED: Final = {
    "sensors": {
        "position": {"rate": 100.0, "noise": 0.01},
        "attitude": {"rate": 100.0, "noise": 0.26},
        "rates": {"rate": 500.0, "noise": 0.43, "bias_walk": 0.0022},
    },
    "estimator": {"type": "error_state"},
}
"""Those of the library's `motion-capture`."""
_LOOP: Final[Table] = {
    "vehicle": "torrente2021",
    "size": 10.0,
    "speeds": (4.0, 6.0, 8.0, 10.0, 12.0, 14.0),
    "course": _loop,
}
WORLDS: Final = {
    "loop": World(
        about="the vehicle of Torrente et al. (2021) on their loop of 5 m radius, as modelled",
        **_LOOP,
        changes={"plant": _PLANT, "effects": {}},
    ),
    "loop, drag": World(about="the same with their drag", **_LOOP, changes={"plant": _PLANT, "effects": _DRAG}),
    "crazyflie2": World(
        about="a Crazyflie 2 on a figure eight of 4 m, with rotor lag (72 ms), rotor inertia and drag",
        vehicle="crazyflie2",
        size=4.0,
        speeds=(2.0, 3.0, 4.0, 5.0),
        course=_eight,
        changes={},
    ),
    "hummingbird": World(
        about="an AscTec Hummingbird on the same, with rotor lag (12.5 ms up, 25 ms down), rotor inertia and drag",
        vehicle="hummingbird",
        size=4.0,
        speeds=(3.0, 4.0, 5.0, 6.0, 7.0),
        course=_eight,
        changes={},
    ),
    "hummingbird, sensors": World(
        about=f"the same by motion capture (1 cm, 0.26 deg, 100 Hz), a gyro and a Kalman filter; {SEEDS} seeds",
        vehicle="hummingbird",
        size=4.0,
        speeds=(4.0, 6.0),
        course=_eight,
        changes=_SENSED,
        seeds=SEEDS,
    ),
}


@dataclass(frozen=True, kw_only=True)
class Given:
    """What a controller is made from: a vehicle, its tuned linear MPC, the control period [s], the bound [deg]."""

    vehicle: Vehicle
    tuned: Table
    period: float
    bound: float

    @property
    def lag(self) -> float:
        """Of the rotors [s]."""
        return self.vehicle.rotor_rise or 0.0

    def baseline(self, **fields: Any) -> Table:
        """Of a law that plans nothing: it limits the tilt that it commands."""
        return {"tilt": self.bound, **fields}

    def robust(self) -> Table:
        """The tuned one, its rotors bounded as those of all."""
        least, most = self.vehicle.speed_min, self.vehicle.speed_max
        return {
            **self.tuned,
            "output_bounds": {name: [-self.bound, self.bound] for name in ("roll", "pitch")},
            "input_bounds": {"speed": [least, most], "slew": [-most, most]},
        }

    def constrained(self) -> Table:
        """The paper's with the same weights and bounds."""
        shared = ("horizon", "output_weights", "input_weights", "output_bounds", "input_bounds")
        return {"type": "constrained", **{name: value for name, value in self.robust().items() if name in shared}}

    def nonlinear(self, **fields: Any) -> Table:
        """By its default weights, over the same time ahead."""
        held = max(1, math.floor(NODE / self.period + 1e-9))
        return {
            "type": "nonlinear",
            "horizon": held * math.ceil(self.tuned["horizon"] / held),
            "node": held * self.period,
            "substeps": math.ceil(held * self.period / self.lag) if self.lag else 1,
            "rotor_lag": self.tuned["rotor_lag"],
            "terminal": "lqr",
            "tilt": self.bound,
            "soft": {},
            **fields,
        }


@dataclass(frozen=True, kw_only=True)
class Law:
    """A controller: whether its model is linear, and its table `[controller]`."""

    about: str
    linear: bool
    table: Callable[[Given], Table]


LAWS: Final = {
    "LQR": Law(
        about="linearised at hover; follows the reference's velocity, not its acceleration",
        linear=True,
        table=lambda given: given.baseline(type="lqr"),
    ),
    "PID": Law(
        about="cascaded, with the reference's acceleration fed forward",
        linear=True,
        table=lambda given: given.baseline(type="pid"),
    ),
    "constrained": Law(about="the paper's MPC, linearised at hover", linear=True, table=Given.constrained),
    "robust": Law(
        about="the same with soft bounds, known lag, heading, and a constant disturbance estimated",
        linear=True,
        table=Given.robust,
    ),
    "geometric": Law(about="on SE(3)", linear=False, table=lambda given: given.baseline(type="geometric")),
    "geometric +": Law(
        about="and flatness feed-forward, changing forces observed, INDI",
        linear=False,
        table=lambda given: given.baseline(
            type="geometric", feedforward=True, indi={}, disturbance={"rotor_lag": given.lag}
        ),
    ),
    "nonlinear": Law(
        about="MPC on the rigid body, one real-time iteration per period", linear=False, table=Given.nonlinear
    ),
    "nonlinear +": Law(
        about="and changing forces observed, and drag fitted to them",
        linear=False,
        table=lambda given: given.nonlinear(disturbance={}),
    ),
}
"""By their names in tables, in order."""


@dataclass(frozen=True, kw_only=True)
class SpeedFlight:
    """One flight, or several seeds of it; numbers are of what was flown, and means over the seeds but for the tilt."""

    bound: float  # on roll and pitch [deg]
    reason: str | None  # why one ended early; None where all were completed
    error: float | None  # mean distance from the reference [m]; None where a flight was lost
    tilt: float  # largest angle between thrust axis and vertical at the physics rate [deg]
    violated: float  # share of the time, at the physics rate, with roll or pitch more than `TOLERANCE` beyond the bound
    saturated: float  # share of periods with a rotor commanded to its lowest or highest speed
    fallback: float  # share of periods not flown by the controller's own answer
    seeds: int = 1  # flights
    lost: int = 0  # how many of them ended early
    # half the 95 % interval of the mean error [m], Student's t; None of one flight, or where one was lost
    half: float | None = None


def merged(flights: Sequence[SpeedFlight]) -> SpeedFlight:
    """Seeds of one flight as one."""
    if len(flights) == 1:
        return flights[0]
    errors = np.array([flight.error for flight in flights if flight.error is not None])
    whole, n = len(errors) == len(flights), len(flights)
    quantile = float(stdtrit(n - 1, 0.5 * (1.0 + CONFIDENCE)))
    return replace(
        flights[0],
        reason=next((flight.reason for flight in flights if flight.reason is not None), None),
        error=float(errors.mean()) if whole else None,
        tilt=max(flight.tilt for flight in flights),
        **{
            name: float(np.mean([getattr(flight, name) for flight in flights]))
            for name in ("violated", "saturated", "fallback")
        },
        seeds=n,
        lost=n - len(errors),
        half=quantile * float(errors.std(ddof=1)) / math.sqrt(n) if whole else None,
    )


@dataclass(frozen=True, kw_only=True)
class SpeedBench:
    """Controllers by worlds and speeds."""

    flights: Mapping[tuple[str, float, str], SpeedFlight]  # by world, speed [m/s] and controller

    @property
    def worlds(self) -> dict[str, list[float]]:
        """The speeds [m/s] flown in each world."""
        found: dict[str, dict[float, None]] = {}
        for world, speed, _ in self.flights:
            found.setdefault(world, {})[speed] = None
        return {world: list(speeds) for world, speeds in found.items()}

    @property
    def laws(self) -> list[str]:
        """The controllers that flew."""
        return list(dict.fromkeys(law for _, _, law in self.flights))

    def to_json(self) -> Table:
        """All of it as plain data."""
        flights = [
            {"world": world, "speed": speed, "controller": law, **asdict(flight)}
            for (world, speed, law), flight in self.flights.items()
        ]
        return {"room": ROOM, "tolerance": TOLERANCE, "flights": flights}


def run_speeds(*, quick: bool = False, workers: int | None = None, progress: Progress = silent) -> SpeedBench:
    """Fly every controller in every world at every speed.

    Results are the same however many processes fly.

    Args:
        quick: two controllers on the loop with drag, at two speeds.
        workers: processes; one per usable core by default.
        progress: called with how much is done, of how much.

    Raises:
        ParameterError: the number of processes is none.
    """
    if workers is not None and workers < 1:
        raise ParameterError("", "--workers", workers, "at least 1")
    cells = [(world, speed, law) for world in WORLDS for speed in WORLDS[world].speeds for law in LAWS]
    if quick:
        cells = [cell for cell in cells if cell[0] == QUICK_WORLD and cell[1] in QUICK_SPEEDS and cell[2] in QUICK_LAWS]
    flown = [(*cell, seed) for cell in cells for seed in range(WORLDS[cell[0]].seeds)]
    found = answers(fly_cell, flown, workers=workers, progress=lambda done, total: progress("flights", done, total))
    flights = iter(found)
    return SpeedBench(flights={cell: merged(list(itertools.islice(flights, WORLDS[cell[0]].seeds))) for cell in cells})


def fly_cell(cell: tuple[str, float, str, int]) -> SpeedFlight:
    """Fly one controller in one world at one speed with one seed, here."""
    world, speed, law = WORLDS[cell[0]], cell[1], LAWS[cell[2]]
    vehicle = load_vehicle(vehicle_path(world.vehicle))
    data = first_scenario(vehicle, world.vehicle, course="figure-eight").to_data()
    tuned, period = data["controller"], data["control_period"]
    data["reference"], data["duration"] = world.course(speed, period)
    data |= {"seed": cell[3], "constraints": [], "lost": {"distance": world.size}, **copy.deepcopy(world.changes)}
    bound = min(STEEPEST, round(report(parse_scenario(data), vehicle).tilt + ROOM))
    data["controller"] = law.table(Given(vehicle=vehicle, tuned=tuned, period=period, bound=bound))
    log = fly_scenario(parse_scenario(data)).log
    # A row of the plant covers the step that follows it; the last has none.
    states, speeds = log.plant.state[:-1], log.control.speeds
    beyond = np.degrees(np.abs(states[:, [INDEX["roll"], INDEX["pitch"]]]).max(axis=1)) > bound + TOLERANCE
    at_end = (speeds <= vehicle.speed_min) | (speeds >= vehicle.speed_max)
    return SpeedFlight(
        bound=bound,
        reason=log.reason,
        error=None if log.reason else float(metrics.tracking(log.control)["position_error"]["mean"]),
        tilt=float(np.degrees(tilt(states)).max()),
        violated=float(beyond.mean()),
        saturated=float(at_end.any(axis=1).mean()),
        fallback=float((log.control.fallback > 0).mean()),
        lost=int(log.reason is not None),
    )


def speed_tables(measured: SpeedBench) -> list[Grid]:
    """How far each controller goes, then errors, violations, tilts and saturation."""
    columns: tuple[tuple[str, str, Callable[[SpeedFlight, bool], Cell], str], ...] = (
        (
            *("error", "Mean position error, m", _error),
            "The smallest at each speed is bold. ±: half the 95 % interval of the mean over seeds.",
        ),
        (
            *("violated", "Share of the time with roll or pitch beyond the bound, %"),
            lambda flight, _: _share(flight.violated),
            f"At the physics rate; by more than {TOLERANCE:g} deg, and before the vehicle was lost, where it was.",
        ),
        (
            *("tilt", "Peak tilt, deg"),
            lambda flight, _: Cell(text=f"{flight.tilt:.0f}", mark=Mark.NONE if flight.reason is None else Mark.BAD),
            "At the physics rate. Lost flights end beyond 120 deg, or farther off than the course's size.",
        ),
        (
            *("saturated", "Share of periods with a rotor at its lowest or highest speed, %"),
            lambda flight, _: _share(flight.saturated),
            "No controller commands speeds beyond these.",
        ),
    )
    return [_reach(measured), *(_grid(measured, *column) for column in columns)]


def _reach(measured: SpeedBench) -> Grid:
    """Up to which speed all goes well."""
    ways: tuple[Callable[[SpeedFlight], bool], ...] = (
        lambda flight: flight.error is not None,
        lambda flight: flight.error is not None and flight.error <= NEAR,
        lambda flight: flight.error is not None and not flight.violated,
    )

    def cell(world: str, law: str) -> str:
        speeds = measured.worlds[world]
        flights = [measured.flights[world, speed, law] for speed in speeds]
        reached = (sum(1 for _ in itertools.takewhile(way, flights)) for way in ways)
        return ", ".join(f"{speeds[count - 1]:g}" if count else ABSENT for count in reached)

    lines = tuple(line(law, *(cell(world, law) for world in measured.worlds)) for law in measured.laws)
    note = (
        f"Of the speeds flown, the highest up to which the vehicle is not lost; its mean error is at most {NEAR:g} m; "
        "it is within its bound all the time."
    )
    title = "Up to which speed, m/s: not lost, followed, within the bound"
    return Grid(key="reach", title=title, head=("controller", *measured.worlds), lines=lines, note=note)


def _grid(measured: SpeedBench, key: str, title: str, cell: Callable[[SpeedFlight, bool], Cell], note: str) -> Grid:
    lines = []
    for world, speeds in measured.worlds.items():
        for speed in speeds:
            flights = [measured.flights[world, speed, law] for law in measured.laws]
            least = min((flight.error for flight in flights if flight.error is not None), default=None)
            cells = (cell(flight, flight.error == least) for flight in flights)
            lines.append(line(world, f"{speed:g}", f"{flights[0].bound:g}", *cells))
    return Grid(key=key, title=title, head=("course", "m/s", "bound", *measured.laws), lines=tuple(lines), note=note)


def _error(flight: SpeedFlight, best: bool) -> Cell:
    if flight.error is None:
        return Cell(text="lost" if flight.lost == flight.seeds else f"{flight.lost} lost", mark=Mark.BAD)
    spread = "" if flight.half is None else f" ± {flight.half:.3f}"
    return Cell(text=f"{flight.error:.3f}{spread}", mark=Mark.BEST if best else Mark.NONE)


def _share(share: float) -> Cell:
    return Cell(text=f"{100.0 * share:.1f}" if share else "0")


def speed_legend(measured: SpeedBench) -> str:
    """What worlds and controllers are, as Markdown lists."""
    lines = [f"- **{name}**: {WORLDS[name].about}" for name in measured.worlds]
    lines += ["", *(f"- **{name}**: {LAWS[name].about}" for name in measured.laws)]
    return "\n".join(lines) + "\n"
