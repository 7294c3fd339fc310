"""The whole scenario file.

`Scenario` is the file as a frozen dataclass, in the file's units (deg, rad/s, s): vehicle, course, controller, effects,
events, constraints.  It holds what was stated; what follows from it, such as the duration of a course, is derived in
`quadsim.scenarios.assembly`.  The fields' annotations are the declaration that `--set`, the JSON Schema, the printed
file and the messages follow from.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, make_dataclass
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, TypeAlias, get_args, get_type_hints

from annotated_types import Ge, Gt, Le, MaxLen, doc
from pydantic import BeforeValidator, Field

from quadsim import shorthands
from quadsim.errors import InputError, ParameterError
from quadsim.fields import FLOORS, Metres, Positive
from quadsim.flight.audit import FlightVerdict, Limit
from quadsim.flight.phase import CRITERIA
from quadsim.input_limits import MOST_ENTRIES, MOST_STEPS
from quadsim.mpc.problem.polytope import Polytope
from quadsim.scenarios.catalogue import Group
from quadsim.scenarios.courses.table import ReferenceTable
from quadsim.scenarios.plugin import PluginForce
from quadsim.scenarios.schema.base import LARGEST_WHOLE
from quadsim.scenarios.schema.controllers import AnyController, changed_controller
from quadsim.scenarios.schema.events import MOST_EVENTS, ControllerEvent, Event, SensorFaultEvent
from quadsim.scenarios.schema.initial import Initial
from quadsim.scenarios.schema.problems import parse_table
from quadsim.scenarios.schema.sensors import EstimatorSpec, Sensors, check_sensing
from quadsim.scenarios.schema.settings import REPEATING, RecordedVehicle, separate, set_field
from quadsim.scenarios.schema.writing import is_absent, plain, to_toml
from quadsim.sim.autopilot import AutopilotSettings
from quadsim.sim.computation import ComputationTime
from quadsim.sim.effects import Effects
from quadsim.sim.effects.load import PayloadDrop, PayloadPickup
from quadsim.sim.physics import Integrator, inner_steps, steps_per_period
from quadsim.space import AnyObstacle, Corridor, Fence
from quadsim.state import STATE_NAMES
from quadsim.vehicle import VEHICLE_UNITS, Vehicle


@dataclass(frozen=True, kw_only=True)
class _Overrides:
    """Parameters of `quadsim.vehicle.Vehicle`, all optional; units as in the vehicle file."""

    def overrides(self) -> dict[str, Any]:
        """The parameters that are set."""
        values = {}
        for name in VEHICLE_UNITS:
            value = getattr(self, name)
            if value is not None:
                values[name] = value
        return values


_VEHICLE_TYPES: Final = get_type_hints(Vehicle, include_extras=True)
_OPTIONAL_PARAMETERS: Final = [(name, _VEHICLE_TYPES[name] | None, field(default=None)) for name in VEHICLE_UNITS]
"""The parameters of a vehicle as fields that may be absent: name, type and default."""


@dataclass(frozen=True, kw_only=True)
class _Modelled(_Overrides):
    """Vehicle file, and parameters that replace those of the file, in model and plant; units as in the file."""

    file: Annotated[str, doc("a shipped vehicle's name, or a path ending in .toml, relative to the scenario file")]


# `Vehicle` alone declares the parameters; both tables take them from it.  A type checker sees the bases.
if TYPE_CHECKING:
    VehicleTable: TypeAlias = _Modelled
    ActualTable: TypeAlias = _Overrides
else:
    VehicleTable = make_dataclass("VehicleTable", _OPTIONAL_PARAMETERS, bases=(_Modelled,), frozen=True, kw_only=True)
    ActualTable = make_dataclass("ActualTable", _OPTIONAL_PARAMETERS, bases=(_Overrides,), frozen=True, kw_only=True)
    VehicleTable.__doc__ = _Modelled.__doc__
    ActualTable.__doc__ = (
        "True parameters where they differ from the model: the plant uses them, the controller does not know them."
    )
    VehicleTable.__module__ = ActualTable.__module__ = __name__


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """The simulated vehicle."""

    timestep: Annotated[float, Ge(1e-6), Le(0.01), doc("[s] physics step")] = 1e-3
    integrator: Annotated[
        Integrator,
        doc(
            "mujoco: MuJoCo's Runge-Kutta step, with motion-dependent forces held over the step; rk4: Runge-Kutta "
            "step of a free rigid body with all forces evaluated at each stage, as in published simulations"
        ),
    ] = "mujoco"
    limit_speeds: Annotated[
        bool, doc("whether rotors saturate at the vehicle's speed_min and speed_max; false: they take any speed >= 0")
    ] = True


def _false_alone(value: object) -> object:
    """Refuse 0, which Python takes for false."""
    if value is not False:
        raise ValueError("must be false")
    return value


Off = Annotated[Literal[False], BeforeValidator(_false_alone)]


@dataclass(frozen=True, kw_only=True)
class Lost:
    """Criteria on the true state, at the control samples, by which a flight is lost; false switches one off."""

    tilt: Annotated[
        Annotated[float, Gt(0.0), Le(180.0)] | Off,
        doc(
            "[deg] largest angle between the thrust axis and the vertical; at 120, half the thrust pulls down; false "
            "for loops and flips"
        ),
    ] = 120.0
    distance: Annotated[Metres | Off, doc("[m] largest distance from the reference at the same time")] = 100.0
    depth: Annotated[Metres | Off, doc("[m] largest depth below the lowest point of start and reference so far")] = 50.0
    speed: Annotated[Positive | Off, doc("[m/s] highest speed in any direction")] = 50.0
    departure: Annotated[
        Metres | Off,
        doc("[m] largest distance from the course flown so far at the end of a flight, while it still grows"),
    ] = 4.0

    @property
    def limits(self) -> dict[str, float]:
        """The criteria that are on and end a flight early, all but `departure`; see `quadsim.flight.phase`."""
        limits = {}
        for name in CRITERIA:
            limit = getattr(self, name)
            if limit is not False:
                limits[name] = limit
        return limits


LONGEST_FLIGHT: Final = 86_400.0
"""Largest duration [s]: a day."""
BOUNDED: Final = (*STATE_NAMES, "tilt", "body_rate_x", "body_rate_y", "body_rate_z", "thrust", "speed", "slew")
"""Signals that controllers can bound."""


@dataclass(frozen=True, kw_only=True, repr=False)
class Scenario:
    """A flight: vehicle, course, controller, effects, events and constraints.

    Examples:
        >>> import quadsim
        >>> scenario = quadsim.load("paper-constrained")
        >>> scenario.duration, scenario.control_period, scenario.controller.horizon
        (60.0, 0.05, 50)
        >>> [constraint.name for constraint in scenario.constraints[:2]]
        ['roll', 'pitch']
    """

    name: Annotated[str, MaxLen(80), doc("letters a-z, digits and . _ -; names the run directory")] = field(
        metadata={"pattern": r"^[a-z0-9][a-z0-9._-]*$"}
    )
    description: Annotated[str, doc("one line for `quadsim list`")]
    group: Annotated[Group, doc("where `quadsim list` shows it: " + ", ".join(get_args(Group)))] = "other"
    expect: Annotated[
        FlightVerdict,
        doc(
            "expected verdict: satisfied (flown to its end, every required constraint satisfied), violated (one "
            "violated, the vehicle crashes, or the controller ends in permanent fallback), lost (the flight ends "
            "early, by a criterion of [lost] or otherwise, or far off its course), incomplete (it ends before a "
            "constraint's window starts), "
            "unaudited (it has no constraint)"
        ),
    ] = "satisfied"
    duration: Annotated[
        float,
        Ge(FLOORS["s"]),
        Le(LONGEST_FLIGHT),
        doc("[s] whole control periods; absent: until the course ends, if it has an end"),
    ] = math.inf
    control_period: Annotated[
        float,
        Ge(FLOORS["s"]),
        Le(10.0),
        doc("[s] tau_s, time for which a command is held; a whole number of physics steps"),
    ]
    seed: Annotated[int, Ge(0), Le(LARGEST_WHOLE), doc("seed of everything random; recorded with the flight")] = 0
    log_rate: Annotated[
        float, Ge(0.01), Le(1e6), doc("[Hz] row rate of plant.parquet; the audit uses every physics step")
    ] = 200.0
    vehicle: VehicleTable
    actual: ActualTable | None = None
    recorded: Annotated[
        RecordedVehicle | None,
        doc("absent: [vehicle] and [autopilot] have only what replaces the vehicle file's numbers"),
    ] = None
    initial: Initial = field(default_factory=Initial)
    plant: Simulation = Simulation()
    reference: ReferenceTable
    controller: AnyController
    autopilot: Annotated[
        AutopilotSettings | None,
        doc("flies a controller that commands thrust and body rates; absent: the vehicle file's, or by rule"),
    ] = None
    effects: Effects = field(default_factory=Effects)
    forces: Annotated[
        tuple[PluginForce, ...],
        MaxLen(MOST_ENTRIES),
        doc("user-defined forces on the vehicle, called once per physics step"),
    ] = ()
    computation: Annotated[ComputationTime | None, doc("absent: commands take no time")] = None
    sensors: Annotated[Sensors | None, doc("absent: the controller receives the true state")] = None
    estimator: Annotated[
        EstimatorSpec | None, doc("absent: the controller receives the raw samples of the sensors")
    ] = None
    events: Annotated[tuple[Event, ...], MaxLen(MOST_EVENTS), doc("timed events during the flight")] = ()
    lost: Lost = Lost()
    obstacles: Annotated[
        tuple[Annotated[AnyObstacle, Field(discriminator="type")], ...],
        MaxLen(MOST_ENTRIES),
        doc("solids; the vehicle, as a ball of radius vehicle.extent, crashes when it touches one"),
    ] = ()
    corridors: Annotated[
        tuple[Corridor, ...],
        MaxLen(MOST_ENTRIES),
        doc("convex regions to stay in during a window of time or of the path"),
    ] = ()
    keep_in: Annotated[Fence | None, doc("a convex region to stay in throughout; absent: none")] = None
    constraints: Annotated[
        tuple[Limit, ...],
        MaxLen(MOST_ENTRIES),
        doc(
            "audited constraints, in addition to the controller's bounds; an entry without bounds takes the "
            "controller's"
        ),
    ] = ()

    # In `vars`, beside the fields: `stated`, the tables that the scenario was parsed from; `restated`, the names of the
    # fields that `altered` has replaced since; `ends_with_course`, whether the duration comes from the course.

    def __post_init__(self) -> None:
        if math.isinf(self.duration):
            self._derive_duration()
        self.require_consistent()

    def _derive_duration(self) -> None:
        """Set the duration to the whole control periods in which the course ends."""
        until: float | None = getattr(self.reference, "until", None)
        if until is None:
            raise ValueError("duration is missing")
        periods = math.ceil(until / self.control_period - 1e-6)  # an excess by rounding makes no period
        duration = round(periods * self.control_period, 9)
        if duration > LONGEST_FLIGHT:
            raise ValueError(f"duration must be <= {LONGEST_FLIGHT}; the course takes {duration}")
        vars(self).update(duration=duration, ends_with_course=True)

    def __repr__(self) -> str:
        parts = f"{self.duration:g} s of {self.vehicle.file}, {self.reference.type} by {self.controller.type}"
        return f"<Scenario {self.name}: {parts}\n {self.description}>"

    def _repr_html_(self) -> str:
        return shorthands.scenario_as_html(self)

    def __dir__(self) -> list[str]:
        """Return the fields and methods for users, for completion in an interactive session."""
        names = []
        for name in super().__dir__():
            if name in _FOR_USERS or name.startswith("__"):
                names.append(name)
        return names

    @property
    def ends_with_course(self) -> bool:
        """Whether the duration comes from the course rather than from the file."""
        return bool(vars(self).get("ends_with_course", False))

    @property
    def tables(self) -> dict[str, Any]:
        """What was stated, as nested tables in file units, without defaults and derived values; a copy."""
        stated: dict[str, Any] | None = vars(self).get("stated")
        if stated is not None:
            tables = copy.deepcopy(stated)
        else:
            tables = self._every_field()
        for name in vars(self).get("restated", ()):
            value = getattr(self, name)
            if is_absent(value):
                tables.pop(name, None)
            else:
                tables[name] = plain(value)
        return tables

    def _every_field(self) -> dict[str, Any]:
        """Return every field with a value, defaults included, except the duration where the course gives it."""
        tables: dict[str, Any] = plain(self)
        if self.ends_with_course:
            del tables["duration"]
        return tables

    def altered(self, **fields: Any) -> Scenario:
        """Return a copy with other values of whole fields, without checking consistency; lists become tuples."""
        other = copy.copy(self)
        for name, value in fields.items():
            if isinstance(value, list):
                vars(other)[name] = tuple(value)
            else:
                vars(other)[name] = value
        restated = {*vars(self).get("restated", ()), *fields}
        vars(other).update(restated=tuple(sorted(restated)))
        if "duration" in fields:
            vars(other).update(ends_with_course=False)
        return other

    def recording(self, vehicle: VehicleTable, autopilot: AutopilotSettings | None) -> Scenario:
        """Return the scenario with these tables, in which it repeats the numbers of its vehicle's file."""
        record = self.recorded
        if record is None:  # what the tables have so far is the scenario's own
            record = RecordedVehicle(file=self.vehicle.file, stated=tuple(self._numbers_of_vehicle()))
        return self.altered(vehicle=vehicle, autopilot=autopilot, recorded=record)

    def _numbers_of_vehicle(self) -> list[str]:
        """Return the paths of the fields of `[vehicle]` and `[autopilot]` that have a value, as vehicle.mass."""
        paths = []
        for table in REPEATING:
            for name in plain(getattr(self, table) or {}):
                if name != "file":
                    paths.append(f"{table}.{name}")
        return paths

    def require_consistent(self) -> None:
        """Refuse fields that are valid alone but inconsistent.

        Raises:
            ValueError: two fields contradict each other.
        """
        self._check_periods()
        self._check_recorded()
        self._check_events()
        controllers = [self.controller]
        for _, controller in self.controller_changes:
            controllers.append(controller)
        self._check_inner_rates(controllers)
        self._check_size(controllers)
        ground = self.effects.ground
        has_floor = ground is not None and ground.contact
        if self.initial.cold and not has_floor:
            raise ValueError("initial.cold must be false where effects.ground gives no floor to stand on; got true")
        check_sensing(self.sensors, self.estimator, timestep=self.plant.timestep)
        self._check_constraints()

    def _check_periods(self) -> None:
        """Refuse a control period, duration or log rate that is no whole number of steps."""
        timestep = self.plant.timestep
        step = f"the physics step plant.timestep = {timestep} s"
        try:
            steps_per_period(self.control_period, timestep)
        except ParameterError:
            raise ValueError(f"control_period must be a whole multiple of {step}; got {self.control_period}") from None
        try:
            steps_per_period(self.duration, self.control_period)
        except ParameterError:
            period = f"the control period = {self.control_period} s"
            raise ValueError(f"duration must be a whole multiple of {period}; got {self.duration}") from None
        try:
            steps_per_period(1.0 / self.log_rate, timestep)
        except ParameterError:
            raise ValueError(
                f"log_rate must have a period that is a whole multiple of {step}; got {self.log_rate}"
            ) from None

    def _check_recorded(self) -> None:
        """Refuse recorded numbers of another vehicle file."""
        if self.recorded is not None and self.recorded.file != self.vehicle.file:
            advice = (
                "for another vehicle remove [recorded], and the numbers of [vehicle] and [autopilot] that repeat it"
            )
            raise ValueError(
                f"recorded.file must be vehicle.file = {self.vehicle.file!r}; got {self.recorded.file!r} ({advice})"
            )

    def _check_inner_rates(self, controllers: Sequence[AnyController]) -> None:
        """Refuse inner loops whose period is no whole number of physics steps."""
        for controller in controllers:
            if controller.indi is not None:
                self._check_inner_rate("controller.indi.rate", controller.indi.rate)
        if self.autopilot is not None and self.autopilot.rate is not None:
            self._check_inner_rate("autopilot.rate", self.autopilot.rate)

    def _check_inner_rate(self, field: str, rate: float) -> None:
        """Refuse a rate [Hz] whose period is no whole number of physics steps."""
        try:
            inner_steps(rate, self.plant.timestep)
        except ParameterError as error:
            raise ValueError(f"{field} must be {error.rule}; got {rate}") from None

    def _check_size(self, controllers: Sequence[AnyController]) -> None:
        """Refuse a flight of too many steps, of the physics or of all plans together."""
        longest_horizon = max(controller.horizon for controller in controllers)
        counts = {
            "physics steps": self.periods * self.steps_per_period,
            "planned steps": self.periods * longest_horizon,
        }
        for what, count in counts.items():
            if count > MOST_STEPS:
                raise ValueError(f"duration must make at most {MOST_STEPS} {what}; got {count}")

    def _check_constraints(self) -> None:
        """Refuse constraints without bounds that no controller has either, and names that stand twice."""
        for entry in self.constraints:
            if not entry.has_bounds and entry.signal not in BOUNDED:
                raise ValueError(
                    f"constraints.{entry.name} must have lower, upper or both; no controller has bounds on "
                    f"{entry.signal}"
                )
        names = self.audited_names
        if len(set(names)) < len(names):
            raise ValueError(f"constraints must have distinct names; got {names}")

    @property
    def polytopes(self) -> tuple[Polytope, ...]:
        """Polytopes of the controller."""
        return self.controller.polytopes

    @property
    def audited_names(self) -> list[str]:
        """The names of constraints, rows of polytopes, obstacles and regions."""
        names = [constraint.name for constraint in self.constraints]
        for polytope in self.polytopes:
            names += polytope.row_names
        for shape in (*self.obstacles, *self.regions):
            names.append(shape.name)
        return names

    def _check_events(self) -> None:
        """Refuse events that do not fit the flight as the events before them leave it."""
        carried = 0
        if self.effects.load is not None:
            carried = len(self.effects.load.payloads)
        controller = self.controller
        in_order_of_time = sorted(enumerate(self.events), key=lambda numbered: numbered[1].at)
        for i, event in in_order_of_time:
            if event.at >= self.duration:
                raise ValueError(f"events.{i}.at must be before the flight's end, {self.duration} s; got {event.at}")
            if isinstance(event, PayloadPickup):
                carried += 1
            elif isinstance(event, PayloadDrop):
                if not carried:
                    raise ValueError(f"events.{i}.type must not be payload_drop at {event.at} s: nothing is carried")
                carried = 0
            elif isinstance(event, SensorFaultEvent):
                self._check_has_sensor(i, event)
            elif isinstance(event, ControllerEvent):
                controller = _controller_after(event, i, controller)

    def _check_has_sensor(self, i: int, event: SensorFaultEvent) -> None:
        """Refuse the fault of a sensor that the estimator does not have.

        Without an estimator the controller receives every quantity, so that each has a sensor that can fail.
        """
        if self.estimator is None:
            return
        names: list[str] = []
        if self.sensors is not None:
            names += map(str, self.sensors.present())
        if event.sensor not in names:
            rule = f"one that the estimator has, of {', '.join(names)}"
            raise ValueError(f"events.{i}.sensor must be {rule}; got {event.sensor!r}")

    @property
    def controller_changes(self) -> list[tuple[float, AnyController]]:
        """Time [s] of each controller change and the new controller, in order of time."""
        changes: list[tuple[float, AnyController]] = []
        controller = self.controller
        for event in sorted(self.events, key=lambda event: event.at):
            if isinstance(event, ControllerEvent):
                controller = changed_controller(controller, event.fields)
                changes.append((event.at, controller))
        return changes

    def controller_at(self, time: float) -> AnyController:
        """Return the controller active at a time [s]."""
        controller = self.controller
        for at, spec in self.controller_changes:
            if at <= time + 1e-9:  # of rounding
                controller = spec
        return controller

    @property
    def regions(self) -> tuple[Corridor | Fence, ...]:
        """Corridors, then the fence."""
        if self.keep_in is None:
            return self.corridors
        return (*self.corridors, self.keep_in)

    @property
    def periods(self) -> int:
        """K, number of control periods in the flight."""
        return steps_per_period(self.duration, self.control_period)

    @property
    def steps_per_period(self) -> int:
        """Physics steps per control period."""
        return steps_per_period(self.control_period, self.plant.timestep)

    @property
    def plant_stride(self) -> int:
        """Physics steps per row of `plant.parquet`."""
        return steps_per_period(1.0 / self.log_rate, self.plant.timestep)

    @classmethod
    def parse(cls, data: Mapping[str, Any], *, source: str = "scenario") -> Scenario:
        """Parse and check a scenario given as nested tables.

        Raises:
            ScenarioError: the message names every invalid field.
        """
        if isinstance(data.get("controller"), str):  # its type alone
            data = {**data, "controller": {"type": data["controller"]}}
        scenario = parse_table(cls, data, source)
        vars(scenario).update(stated=copy.deepcopy(dict(data)))
        return scenario

    def derive(self, tables: Mapping[str, Any], *, source: str | None = None) -> Scenario:
        """Return the scenario of changed `tables` of this one, checked as a file is; messages call it `source`.

        Raises:
            ScenarioError: the message names every invalid field.
        """
        if source is None:
            source = self.name
        other = Scenario.parse(tables, source=source)
        # The rows of a reference that was passed in as a function are in memory, not in the tables.
        if other.reference == self.reference:
            return other.altered(reference=self.reference)
        return other

    def replace(self, changes: Mapping[Any, Any]) -> Scenario:
        """Return a scenario with other values of some fields; this one is unchanged.

        Args:
            changes: new values by dotted path, as after `--set`: an entry of a list of tables by its name, or else its
                index.  Units as in the file; None removes a field.  A tuple of paths takes one value for all, or a
                tuple of one value per path.

        Raises:
            InputError: a field does not exist, or a value is not allowed.

        Examples:
            >>> import quadsim
            >>> scenario = quadsim.load("paper-constrained")
            >>> longer = scenario.replace({"controller.horizon": 30, "vehicle.mass": 4.2})
            >>> scenario.controller.horizon, longer.controller.horizon
            (50, 30)
            >>> both = ("controller.output_bounds.roll", "controller.output_bounds.pitch")
            >>> scenario.replace({both: [-2.0, 2.0]}).controller.output_bounds
            {'roll': (-2.0, 2.0), 'pitch': (-2.0, 2.0)}
        """
        tables = self.tables
        defaults = plain(self)
        for path, value in separate(changes, source="replace").items():
            if hasattr(value, "tolist"):  # of numpy
                value = value.tolist()
            set_field(tables, path, value, source="replace", defaults=defaults)
        return self.derive(tables)

    def fly(self, **options: Any) -> Any:
        """Return the `quadsim.Flight`; `scenario.fly(controller=...)` is `quadsim.fly(scenario, controller=...)`.

        Examples:
            >>> import quadsim
            >>> quadsim.load("hover", {"duration": 1.0}).fly().outcome
            'satisfied'
        """
        return shorthands.fly_scenario(self, **options)

    def to_toml(self) -> str:
        """Return the file: every field, defaults included, with comments; parsing it gives this scenario.

        A derived duration stands in a comment.
        """
        return self.written(self)

    def written(self, resolved: Scenario) -> str:
        """Return the file as `to_toml`; comments show what `resolved` has and this scenario does not state."""
        repeated: dict[str, str] = {}
        if self.recorded is not None:
            for path in self._numbers_of_vehicle():
                if path not in self.recorded.stated:
                    repeated[path] = self.recorded.file
        return to_toml(resolved, self._every_field(), repeated)


def _controller_after(event: ControllerEvent, i: int, controller: AnyController) -> AnyController:
    """Return a controller as event number `i` changes it.

    Raises:
        ValueError: the fields of the event do not fit the controller; the message names each problem.
    """
    try:
        return changed_controller(controller, event.fields)
    except InputError as error:
        problems = getattr(error, "problems", (error,))
        raise ValueError(f"events.{i}.fields: {'; '.join(map(str, problems))}") from None


_FOR_USERS: Final = {*Scenario.__dataclass_fields__, "replace", "fly", "to_toml"}
