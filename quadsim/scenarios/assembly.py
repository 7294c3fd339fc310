"""Build the parts of a scenario's flight once each: vehicle, course, controller, plant and sensors.

Between the file (`quadsim.scenarios.schema.scenario`) and the flight (`quadsim.rollout.rollout`).  Here file units
become SI units, and numbers that the file leaves out are derived: the vehicle's own numbers, the duration of a course,
the solver.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, is_dataclass, replace
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from quadsim.assets import vehicle_path
from quadsim.border import user_code
from quadsim.controller import ATTITUDE, CORE, ROTORS
from quadsim.errors import InputError, ParameterError, QuadsimError
from quadsim.fields import filled
from quadsim.flight.metrics import CourseStep
from quadsim.flight.phase import PhaseMonitor
from quadsim.mpc.laws.parts.builders import build, stated
from quadsim.mpc.pilot.pilot import Pilot
from quadsim.mpc.problem.flatness import motion_along
from quadsim.mpc.tables.bounded import Bounded, Weighted
from quadsim.rotation import body_to_euler_rates
from quadsim.scenarios.courses.along_path import along_path
from quadsim.scenarios.courses.course import Course, Headed, repeated
from quadsim.scenarios.courses.csv_course import Csv
from quadsim.scenarios.courses.followed import FollowedCourse
from quadsim.scenarios.courses.steps import Steps
from quadsim.scenarios.limits import audit_notes, flyable, signal_limits, space_limits, sum_limits, with_user_bounds
from quadsim.scenarios.plugin import Plugin, import_plugin, make_force, reason_of
from quadsim.scenarios.schema.events import ControllerEvent, Event, SensorFaultEvent, SetpointEvent, events_of
from quadsim.scenarios.schema.problems import parse_table
from quadsim.scenarios.schema.writing import plain
from quadsim.sim.airframe import outline
from quadsim.sim.autopilot import (
    Autopilot,
    AutopilotSettings,
    built_in_attitude_lags,
    built_in_lags,
    identify_attitude_lags,
    identify_lags,
)
from quadsim.sim.computation import Computation, ComputationTime, Stall, check_measured, times_by_solver
from quadsim.sim.effects import Change, Disturbance, Effects, Force, Push, push_changes
from quadsim.sim.effects.rotors import LagChange, RotorDynamics, RotorLoss, efficiency_changes
from quadsim.sim.effects.wind import Air, Gust, WindChange, WindField
from quadsim.sim.navigation import Navigation
from quadsim.sim.physics import physics_to_state
from quadsim.sim.plant import Plant
from quadsim.sim.sensing import Sensor, SensorFault, SensorName
from quadsim.space import Corridor, Fence
from quadsim.state import (
    ANGLE_RATES,
    ANGLES,
    VELOCITIES,
    Array,
    make_state,
    nearest_turn,
)
from quadsim.vehicle import (
    AUTOPILOT,
    N_ROTORS,
    VEHICLE_DISTURBANCE,
    VEHICLE_UNITS,
    Vehicle,
    altered,
    load_vehicle,
    missing_parameters,
    overridden,
    vehicle_table,
)

if TYPE_CHECKING:
    from quadsim.controller import AutopilotLoop, Controller
    from quadsim.flight.audit import Limit, SpaceLimit
    from quadsim.motion import Motion
    from quadsim.mpc.problem.ocp import Problem
    from quadsim.scenarios.schema.controllers import AnyController
    from quadsim.scenarios.schema.scenario import Scenario, VehicleTable


class _EffectField(NamedTuple):
    """The field of an effect's table that a vehicle parameter fills.

    Attributes:
        table: of `[effects]`.
        field: of the table; it may state the parameter itself.
        table_type: makes the table where `[effects]` lacks it; None: without its table the effect does not act.
    """

    table: str
    field: str
    table_type: type[RotorDynamics | Air] | None


_EFFECT_OF_PARAMETER: Final = {
    "rotor_rise": _EffectField("rotors", "rise", RotorDynamics),
    "rotor_fall": _EffectField("rotors", "fall", RotorDynamics),
    "rotor_inertia": _EffectField("rotors", "inertia", RotorDynamics),
    "rotor_drag": _EffectField("air", "rotor_drag", Air),
    "inflow": _EffectField("air", "inflow", Air),
    "rotor_moment": _EffectField("air", "rotor_moment", Air),
    "inflow_moment": _EffectField("air", "inflow_moment", Air),
    "rate_damping": _EffectField("air", "rate_damping", Air),
    "body_drag": _EffectField("air", "body_drag", Air),
    "rotor_radius": _EffectField("ground", "rotor_radius", None),
}
"""The vehicle parameters that act in an effect."""
_SHARED_PARTS: Final = (
    "vehicle",
    "autopilot",
    "user_autopilot",
    "inner_lag",
    "attitude_lag",
    "actual",
    "effects",
    "course",
)
"""Parts that do not depend on events, controller or duration."""


@dataclass(frozen=True, kw_only=True)
class _Piloted:
    """The `[autopilot]` of a vehicle file, parsed within a table so that messages name it: autopilot.rate."""

    autopilot: AutopilotSettings


@dataclass(frozen=True, kw_only=True)
class _Disturbed:
    """The `[disturbance]` of a vehicle file, within a table as `_Piloted`."""

    disturbance: Disturbance


class Assembly:
    """The parts of a scenario; each call of a method builds a new part if it has a state.

    Attributes:
        scenario: the file's content.
        user_autopilot: an inner loop that flies in place of the built-in autopilot, for one flight at a time; or None.

    Examples:
        >>> import quadsim
        >>> from quadsim.scenarios.assembly import Assembly
        >>> assembly = Assembly(quadsim.load("paper-constrained"))
        >>> assembly.vehicle.name, assembly.controller().horizon, assembly.reference(100).shape
        ('lopes2011', 50, (100, 4))
    """

    user_autopilot: AutopilotLoop | None = None

    def __init__(self, scenario: Scenario, vehicle: Vehicle | None = None) -> None:
        """Build nothing yet; `vehicle` saves loading it again."""
        self.scenario = scenario
        if vehicle is not None:
            self.vehicle = vehicle

    def __reduce__(self) -> tuple[type[Assembly], tuple[Scenario, Vehicle]]:
        """Pickle the arguments: courses hold functions."""
        return Assembly, (self.scenario, self.vehicle)

    def of(self, scenario: Scenario) -> Assembly:
        """Return the assembly of a scenario with other events, controller or duration; vehicle and course stay."""
        if scenario is self.scenario:
            return self
        other = Assembly(scenario)
        for name in _SHARED_PARTS:
            if name in vars(self):  # a cached part is there once it has been built
                vars(other)[name] = vars(self)[name]
        return other

    @property
    def resolved(self) -> Assembly:
        """The assembly of the scenario with every derived value stated: numbers of its vehicle, sizes and solver."""
        return self.of(self._with_derived_values(self.scenario))

    def _with_derived_values(self, scenario: Scenario) -> Scenario:
        """Return a scenario with every derived value stated; it is that of this assembly, or its `recording`."""
        controller, events = self._controllers_with_solver()
        vehicle, autopilot = self._whole_tables
        fields = {"vehicle": vehicle, "autopilot": autopilot, "effects": self.effects}
        return scenario.altered(**fields, controller=controller, events=events)

    @property
    def recorded(self) -> Assembly:
        """The assembly of the scenario with the numbers of its vehicle's file, `recording`."""
        return self.of(self.recording)

    @property
    def recording(self) -> Scenario:
        """The scenario with the numbers of its vehicle's file, which it then does not need.

        Effects continue to take their sizes from the vehicle.
        """
        vehicle, autopilot = self._whole_tables
        return self.scenario.recording(vehicle, autopilot)

    @property
    def _whole_tables(self) -> tuple[VehicleTable, AutopilotSettings | None]:
        """The tables `[vehicle]` and `[autopilot]` with the numbers of the vehicle's file."""
        numbers = {name: getattr(self.vehicle, name) for name in VEHICLE_UNITS}
        return replace(self.scenario.vehicle, **numbers), self.autopilot

    def to_toml(self, scenario: Scenario | None = None) -> str:
        """Return the scenario's file, or that of `recording`.

        It has what the scenario states, defaults included; what is derived stands in comments.
        """
        if scenario is None:
            scenario = self.scenario
        resolved = self._with_derived_values(scenario)
        with_stated_events = resolved.altered(events=scenario.events)  # a file keeps its events as they are
        return scenario.written(with_stated_events)

    def audited(self) -> Assembly:
        """Return the assembly with the bounds of a user's controller as constraints; it builds that controller."""
        if not isinstance(self.scenario.controller, Plugin):
            return self
        return self.with_user_bounds(self.controller())

    # --- vehicle -----------------------------------------------------------------------------------------------------

    @cached_property
    def vehicle(self) -> Vehicle:
        """The modelled vehicle: its file with the scenario's numbers in place of the file's.

        A resolved or recorded scenario has every number, and needs no file.
        """
        file = self.scenario.vehicle.file
        overrides = self._overrides
        try:
            path = vehicle_path(file)
        except InputError:
            if missing_parameters(overrides):
                raise
            return Vehicle(name=Path(file).stem, **overrides)
        return load_vehicle(path, overrides)

    @property
    def _overrides(self) -> dict[str, Any]:
        """The numbers of `[vehicle]`: those recorded from its file, replaced by those stated."""
        numbers = self.scenario.vehicle.overrides()
        recorded = self.scenario.recorded
        if recorded is None:
            return numbers
        stated = {}
        repeated = {}
        for name, value in numbers.items():
            if f"vehicle.{name}" in recorded.stated:
                stated[name] = value
            else:
                repeated[name] = value
        together = overridden(repeated, stated)
        return {name: value for name, value in together.items() if value is not None}  # None: replaced in another form

    @cached_property
    def autopilot(self) -> AutopilotSettings | None:
        """`[autopilot]` of the scenario over that of the vehicle file; None if neither has one.

        Raises:
            InputError: a field of the vehicle file's is wrong.
        """
        stated = self.scenario.autopilot
        try:
            path = vehicle_path(self.scenario.vehicle.file)
        except InputError:  # a resolved scenario needs no file
            return stated
        return stated_autopilot(path, stated)

    @cached_property
    def actual(self) -> Vehicle:
        """The actual vehicle: the modelled one with the values of `[actual]`.

        Plant, forces, drawings and audit use it; controller, estimator and reference use the modelled one.

        Raises:
            ParameterError: the vehicle is impossible.
        """
        modelled = self.vehicle
        parameters = self._actual_parameters
        if "throttle_offset" in parameters:
            rule = "absent: the plant takes rotor speeds, only logs have a throttle"
            raise ParameterError("actual", "throttle_offset", parameters["throttle_offset"], rule)
        try:
            return altered(modelled, parameters)
        except ParameterError as error:
            raise ParameterError("actual", error.name, error.value, error.rule) from None

    @property
    def _actual_parameters(self) -> dict[str, Any]:
        """The vehicle parameters that `[actual]` states."""
        if self.scenario.actual is None:
            return {}
        return self.scenario.actual.overrides()

    @cached_property
    def effects(self) -> Effects:
        """The effects on the plant: `[effects]`, with every size left to the actual vehicle filled in.

        Lag, rotor inertia and drag that `[actual]` states act even if `[effects]` lacks their table.

        Raises:
            ParameterError: `[effects]` contradicts `[actual]`, lacks a size, or combines effects that exclude each
                other.
        """
        effects = self.scenario.effects
        acting: dict[str, Any] = {}
        for name, size in self._actual_parameters.items():
            if name not in _EFFECT_OF_PARAMETER:
                continue
            table, field, table_type = _EFFECT_OF_PARAMETER[name]
            settings = getattr(effects, table)
            if settings is None and table_type is not None:
                settings = table_type()
            if settings is None:
                continue
            size_of_effect = getattr(settings, field)
            if size_of_effect is not None and size_of_effect != size:
                rule = f"absent where effects.{table}.{field} = {size_of_effect} states it"
                raise ParameterError("actual", name, size, rule)
            acting[table] = settings
        return replace(effects, **acting).resolved(self.actual)

    def initial_state(self, motion: Motion | None = None) -> Array:
        """Return (12,) the state at t = 0, that of the reference motion if the scenario starts on it."""
        initial = self.scenario.initial
        if initial.on_reference and motion is not None:
            # A row as `physics_to_state` takes it: time, position, quaternion, velocity, body rates.
            physics = np.array(
                [0.0, *motion.position[0], *motion.attitude[0], *motion.velocity[0], *motion.body_rates[0]]
            )
            return physics_to_state(physics[None], yaw=self.initial_yaw)[0]
        x, y, z = initial.position
        roll, pitch, _ = np.radians(initial.euler)
        state = make_state(position=(x, y, z), euler=(roll, pitch, self.initial_yaw))
        state[VELOCITIES] = initial.velocity
        if any(initial.body_rates):
            state[ANGLE_RATES] = body_to_euler_rates(state[ANGLES], np.radians(initial.body_rates))
        return state

    @property
    def initial_yaw(self) -> float:
        """The yaw at t = 0, within half a turn of 0 [rad]: a flight counts its turns from there."""
        return math.radians(nearest_turn(self.scenario.initial.euler[2], turn=360.0))

    @property
    def initial_speeds(self) -> Array:
        """(4,) u(-1), and the rotor speeds at t = 0 [rad/s]."""
        initial = self.scenario.initial
        if initial.rotor_speeds is not None:
            return np.array(initial.rotor_speeds)
        if initial.cold:
            return np.zeros(N_ROTORS)
        return self.vehicle.hover_speeds

    # --- course ------------------------------------------------------------------------------------------------------

    @cached_property
    def course(self) -> Course:
        """The course before its filter.

        Raises:
            InputError: its file is wrong, or it does not match the initial position.
        """
        reference = self.scenario.reference
        course = reference.build(self.initial_pose, self.vehicle.gravity)
        if reference.repeat is not None:
            course = repeated(course, reference.repeat, until=self.scenario.duration)
        if isinstance(reference, Headed) and reference.looks_ahead:
            rate = math.radians(reference.yaw_rate)
            course = along_path(course, response_time=reference.response_time, rate=rate)
        return course

    @property
    def course_cut(self) -> float | None:
        """End of the course [s] where the flight is over before it; else None.

        Courses without an end are never cut, nor is a function of time, which is sampled for the flight.
        """
        reference = self.scenario.reference
        end = self.course.end
        if isinstance(reference, Csv) and reference.content is not None:
            return None
        if self.scenario.duration < end - 1e-9 and math.isfinite(end):
            return round(end, 9)
        return None

    @property
    def initial_pose(self) -> Array:
        """(4,) x, y, z [m], yaw [rad] of the vehicle at t = 0."""
        initial = self.scenario.initial
        return np.array([*initial.position, self.initial_yaw])

    def followed(self, course: Course | None = None) -> FollowedCourse:
        """Return the filtered reference row by row, with set-points in flight; `course` replaces the scenario's."""
        if course is None:
            course = self.course
        response_time = self.scenario.reference.response_time
        return FollowedCourse(course, response_time=response_time, period=self.scenario.control_period)

    def reference(self, samples: int) -> Array:
        """(samples, 4) filtered x, y, z [m], yaw [rad] at t_k = k tau_s, without set-points.  Eqs. (30)-(31)."""
        return self.followed().first(samples)

    @cached_property
    def motion(self) -> Motion | None:
        """The reference motion at t_k = k tau_s, to the end of the course; None if the course states only positions."""
        course = self.course
        period = self.scenario.control_period
        if course.derivatives is None:
            return None
        periods = max(math.floor(course.end / period + 1e-6), 1)
        t = np.arange(periods + 1, dtype=np.float64) * period
        velocity, acceleration = course.derivatives(t)
        poses = course.sample(t)
        position = poses[:, :3]
        yaw: Array | float
        if course.stated_heading:
            yaw = poses[:, 3]
        elif course.free_heading:
            yaw = float(course.initial[3])  # where it starts
        else:
            yaw = np.full(len(t), course.initial[3])  # held
        return motion_along(position, velocity, acceleration, period=period, vehicle=self.vehicle, yaw=yaw)

    @cached_property
    def regions(self) -> tuple[Corridor | Fence, ...]:
        """The corridors, each with a window of time, then the fence.

        The reference is known before the flight and moves forward along its path, so a window of the path is a window
        of time.

        Raises:
            InputError: the reference's path ends before a window starts, or cannot be built.
        """
        corridors = self.scenario.corridors
        if all(corridor.path is None for corridor in corridors):
            return self.scenario.regions
        reference = self.reference(self.scenario.periods + 1)[:, :3]
        t = self.scenario.control_period * np.arange(len(reference), dtype=np.float64)
        regions: list[Corridor | Fence] = [corridor.timed(t, reference) for corridor in corridors]
        if self.scenario.keep_in is not None:
            regions.append(self.scenario.keep_in)
        return tuple(regions)

    @property
    def course_steps(self) -> tuple[CourseStep, ...]:
        """The steps of the unfiltered course, channel by channel; a start away from the course is a step at 0.

        Only courses made of windows have steps whose settling is measured, and only on axes without a set-point.
        """
        scenario = self.scenario
        if not isinstance(scenario.reference, Steps):
            return ()
        with_set_point: set[str] = set()
        for event in events_of(scenario.events, SetpointEvent):
            with_set_point.update(event.values)
        preview = scenario.controller.horizon * scenario.control_period
        steps = scenario.reference.course_steps(self.initial_pose, duration=scenario.duration, preview=preview)
        return tuple(step for step in steps if step.channel not in with_set_point)

    # --- controller --------------------------------------------------------------------------------------------------

    def controller(self, spec: AnyController | None = None) -> Pilot:
        """Return the controller, or the one of another table, ready to fly.

        Raises:
            InputError: it cannot be built from these numbers, or its code cannot be found or called.
        """
        if spec is None:
            spec = self.scenario.controller
        spec = self._with_lags(spec)
        shapes = (*self.scenario.obstacles, *self.regions)
        pilot = build(spec, self.vehicle, self.scenario.control_period, shapes)
        check_measured(self.scenario.computation, pilot)
        return self.with_autopilot(pilot)

    def _with_lags(self, spec: AnyController) -> AnyController:
        """Return a controller's table with the lags of the autopilot that flies its commands, where it states none."""
        if not is_dataclass(spec):
            return spec
        lags = {}
        if spec.commands != ROTORS and spec.inner_lag is None:
            lags["inner_lag"] = self.inner_lag
        if spec.turns_by_attitude and spec.attitude_lag is None:
            lags["attitude_lag"] = self.attitude_lag
        return replace(spec, **lags)

    def _controllers_with_solver(self) -> tuple[AnyController, tuple[Event, ...]]:
        """Return controller and events with the `solver` of each controller stated, to fly as without.

        An event that changes only some fields inherits the solver that is now stated before it.  Where its controller
        would choose another one, the event has to state that.
        """
        controller = self._with_solver(self.scenario.controller)
        inherited = _solver_of(controller)
        stating_solver: dict[int, Event] = {}  # by the identity of the event that they replace
        ordered = sorted(events_of(self.scenario.events, ControllerEvent), key=attrgetter("at"))
        for event, (_, spec) in zip(ordered, self.scenario.controller_changes, strict=True):
            solver = _solver_of(self._with_solver(spec))
            inherits = "type" not in event.fields and "solver" not in event.fields
            if inherits and solver != inherited:
                stating_solver[id(event)] = replace(event, fields={**event.fields, "solver": solver})
            inherited = solver
        events = tuple(stating_solver.get(id(event), event) for event in self.scenario.events)
        return controller, events

    def _with_solver(self, spec: AnyController) -> AnyController:
        """See `quadsim.mpc.laws.parts.builders.stated`."""
        shapes = (*self.scenario.obstacles, *self.regions)
        return stated(spec, self.vehicle, self.scenario.control_period, shapes)

    def with_autopilot(self, pilot: Pilot) -> Pilot:
        """Return a pilot with the autopilot that flies its law's commands; itself where these are rotor speeds."""
        if pilot.commands == ROTORS:
            return pilot
        with self._calling_autopilot():
            autopilot = self.user_autopilot or Autopilot(self.vehicle, self.autopilot)
            return Pilot(pilot.law, self.vehicle, guard=pilot.guard, inner=autopilot, attitudes=pilot.attitudes)

    @cached_property
    def inner_lag(self) -> tuple[float, ...]:
        """(4,) first-order lags of thrust and body rates [s], by a step on the autopilot."""
        timestep = self.scenario.plant.timestep
        if self.user_autopilot is not None:
            with self._calling_autopilot():
                return identify_lags(self.vehicle, self.user_autopilot, timestep=timestep)
        return built_in_lags(self.vehicle, self.autopilot or AutopilotSettings(), timestep)

    @cached_property
    def attitude_lag(self) -> tuple[float, ...]:
        """(3,) lags of roll, pitch and yaw behind a commanded attitude [s], by a step on the autopilot."""
        timestep = self.scenario.plant.timestep
        _, *rate_lags = self.scenario.controller.inner_lag or self.inner_lag
        if self.user_autopilot is not None:
            with self._calling_autopilot():
                return identify_attitude_lags(self.vehicle, self.user_autopilot, tuple(rate_lags), timestep=timestep)
        settings = self.autopilot or AutopilotSettings()
        return built_in_attitude_lags(self.vehicle, settings, tuple(rate_lags), timestep)

    def _calling_autopilot(self) -> AbstractContextManager[None]:
        """Turn whatever an autopilot that was passed in raises into an `InputError` that names it."""

        def error_of(error: BaseException) -> InputError:
            name = type(self.user_autopilot).__name__
            return InputError(f"autopilot: {name} cannot be used: {reason_of(error)}")

        return user_code(error_of, passing=(QuadsimError,))

    @property
    def autopilot_flown(self) -> dict[str, Any]:
        """What flew the targets: the class of an autopilot passed in, or `built-in`, and the lags that the law knew."""
        flown: dict[str, Any] = {"name": "built-in"}
        if self.user_autopilot is not None:
            flown["name"] = type(self.user_autopilot).__name__
        controller = self.scenario.controller
        built = vars(self)  # has a lag once a controller has been built with it
        inner_lag = controller.inner_lag or built.get("inner_lag")
        if inner_lag is not None:
            flown["inner_lag"] = [*inner_lag]
        attitude_lag = controller.attitude_lag or built.get("attitude_lag")
        if attitude_lag is not None:
            flown["attitude_lag"] = [*attitude_lag]
        return flown

    def problem(self) -> Problem:
        """The controller's optimisation.

        Raises:
            InputError: the controller has none.
        """
        spec = self.scenario.controller
        if not isinstance(spec, Weighted):
            from quadsim.scenarios.schema.controllers import TABLES

            linear = [name for name, table in TABLES.items() if issubclass(table, Weighted)]
            rule = f"one that solves a linear problem over a horizon: {', '.join(linear)}"
            raise ParameterError("controller", "type", spec.type, rule)
        return spec.problem(self.vehicle, self.scenario.control_period)

    @cached_property
    def bounds(self) -> dict[str, tuple[float, float]]:
        """The controller's bounds on signals of the audit, in file units; those on speeds within the rotors' range.

        See `quadsim.mpc.tables.controller.ControllerTable.audited`.  Audit, notes and feasibility all take these.
        """
        return flyable(self.scenario.controller.audited(self.vehicle), self.actual)

    @cached_property
    def limits(self) -> tuple[Limit, ...]:
        """The limits of the audit: constraints, controller bounds, polytopes, obstacles and regions."""
        return (*signal_limits(self.scenario, self.bounds), *sum_limits(self.scenario), *self.space_limits)

    @property
    def space_limits(self) -> tuple[SpaceLimit, ...]:
        """The limits of the audit by obstacles and regions alone."""
        scenario = self.scenario
        regions = self.regions
        if not scenario.obstacles and not regions:
            return ()
        return space_limits(scenario.obstacles, regions, self.actual.enclosing_radius)

    @property
    def with_bounds(self) -> Scenario:
        """The scenario with its controller's bounds as constraints, to apply them to another controller."""
        return self.scenario.altered(constraints=signal_limits(self.scenario, self.bounds))

    def with_user_bounds(self, controller: Controller) -> Assembly:
        """Return the assembly with the bounds of a user's controller as constraints of its scenario."""
        scenario = with_user_bounds(self.scenario, controller)
        if scenario is self.scenario:
            return self
        return self.of(scenario)

    @property
    def audit_notes(self) -> list[str]:
        """Notes on the audit, see `quadsim.scenarios.limits.audit_notes`."""
        return audit_notes(self.scenario, self.vehicle, self.bounds, audited=bool(self.limits))

    def computation(self, spec: AnyController | None = None) -> Computation | None:
        """Return the computation time of a controller, the scenario's by default; None if commands take no time."""
        if spec is None:
            spec = self.scenario.controller
        stalls = events_of(self.scenario.events, Stall)
        settings = self.scenario.computation
        if settings is None and not stalls:
            return None
        has_fallback = spec.fallback is not None and spec.fallback.enabled
        continues_plan = has_fallback and not spec.turns_by_attitude  # where the settings do not say
        settings = filled(settings or ComputationTime(), plan=continues_plan)
        if settings.plan and spec.turns_by_attitude:
            rule = f'false where controller.commands = "{ATTITUDE}": a plan has body rates, not later attitudes'
            raise ParameterError("computation", "plan", True, rule)
        settings = replace(settings, per_iteration=times_by_solver(settings.per_iteration))
        return Computation(**vars(settings), stalls=stalls)

    # --- plant -------------------------------------------------------------------------------------------------------

    def generator(self, purpose: str) -> np.random.Generator:
        """Return a random generator for one purpose, e.g. `wind`, from the seed, independent of other draws."""
        return np.random.default_rng(np.random.SeedSequence([self.scenario.seed, zlib.crc32(purpose.encode())]))

    def plant(self, forces: Sequence[Force] | None = None) -> Plant:
        """Return the simulated vehicle with its effects; `forces` replaces those of the scenario.

        Raises:
            InputError: effects exclude each other, or a force cannot be imported.
        """
        scenario = self.scenario
        if forces is None:
            forces = self._forces()
        has_actual_limits = "speed_min" in self._actual_parameters or "speed_max" in self._actual_parameters
        return Plant(
            self.actual,
            timestep=scenario.plant.timestep,
            integrator=scenario.plant.integrator,
            limit_speeds=scenario.plant.limit_speeds or has_actual_limits,
            effects=self.effects,
            changes=self.changes(),
            wind=self.wind(),
            forces=forces,
            obstacles=scenario.obstacles,
            rng=self.generator("disturbance"),
        )

    def _forces(self) -> list[Force]:
        """Return the user-defined forces of the scenario, which share one random generator."""
        rng = self.generator("forces")
        forces = []
        for spec in self.scenario.forces:
            code = import_plugin(spec)
            forces.append(make_force(code, spec, self.actual, rng))
        return forces

    def ground(self) -> PhaseMonitor | None:
        """Return the monitor of contact with ground and obstacles; None if there are none."""
        ground = self.scenario.effects.ground
        obstacles = self.scenario.obstacles
        has_floor = ground is not None and ground.contact
        if not has_floor and not obstacles:
            return None
        shape = None
        if has_floor:
            shape = outline(self.actual)
        radius = self.actual.enclosing_radius
        return PhaseMonitor(shape, period=self.scenario.control_period, obstacles=obstacles, radius=radius)

    @property
    def moving_air(self) -> Air | None:
        """The resolved air if it moves at some time of the flight, or None if it is always still.

        Raises:
            ParameterError: there is wind, but nothing for it to push.
        """
        air = self.effects.air or Air()
        gusts, changes = self.winds
        moves = any(air.wind) or air.turbulence is not None or gusts or changes
        if not moves:
            return None
        air.require_drag(self.vehicle)
        return air

    def wind(self) -> WindField | None:
        """Return the wind field, or None if the air is always still; raises as `moving_air`."""
        air = self.moving_air
        if air is None:
            return None
        gusts, changes = self.winds
        return WindField(
            mean=air.wind,
            gusts=gusts,
            changes=changes,
            turbulence=air.turbulence,
            timestep=self.scenario.plant.timestep,
            rng=self.generator("wind"),
        )

    @property
    def winds(self) -> tuple[tuple[Gust, ...], tuple[WindChange, ...]]:
        """The gusts, and the steps of the mean wind."""
        events = self.scenario.events
        return events_of(events, Gust), events_of(events, WindChange)

    def changes(self, events: Sequence[Event] | None = None) -> tuple[Change, ...]:
        """Return the changes by these events, or by all, to rotors, mass, payload and pushes, in any order.

        Raises:
            ParameterError: rotors with inertia would change their speed at once.
        """
        if events is None:
            events = self.scenario.events
        rotors = self.effects.rotors or RotorDynamics()
        for event in events_of(events, LagChange):
            rotors.lagging(event)  # built only to be checked
        losses = events_of(events, RotorLoss)
        pushes = events_of(events, Push)
        of_plant = [event for event in events if isinstance(event, Change)]
        return (*efficiency_changes(losses, rotors.efficiency), *push_changes(pushes), *of_plant)

    # --- sensors -----------------------------------------------------------------------------------------------------

    def navigation(self) -> Navigation | None:
        """Return the source of the controller's state; None if it receives the true state.

        Raises:
            ParameterError: a fault of a sensor that the estimator does not have.
        """
        sensors = self.sensors
        faults = self.faults
        estimator = self.scenario.estimator
        if not sensors and not faults and estimator is None:
            return None
        step = self.scenario.plant.timestep
        rng = self.generator("sensors")
        return Navigation(self.vehicle, timestep=step, sensors=sensors, rng=rng, faults=faults, estimator=estimator)

    @property
    def sensors(self) -> dict[SensorName, Sensor]:
        """The scenario's sensors."""
        if self.scenario.sensors is None:
            return {}
        return self.scenario.sensors.present()

    @property
    def faults(self) -> tuple[SensorFault, ...]:
        """The faults of the sensors."""
        faults = events_of(self.scenario.events, SensorFaultEvent)
        return tuple(event.in_si() for event in faults)


def stated_autopilot(path: Path, stated: AutopilotSettings | None = None) -> AutopilotSettings | None:
    """Return the `[autopilot]` of a vehicle file with the fields that `stated` has; None if neither has any.

    Raises:
        InputError: a field of the file's is wrong.
    """
    of_file = vehicle_table(path, AUTOPILOT)
    if not of_file:
        return stated
    table = dict(of_file)
    if stated is not None:
        table |= plain(stated)
    return parse_table(_Piloted, {AUTOPILOT: table}, str(path), file="vehicle").autopilot


def stated_disturbance(path: Path) -> Disturbance | None:
    """Return the `[disturbance]` of a vehicle file, which is what flights of it met; None without it.

    Raises:
        InputError: a field of it is wrong.
    """
    of_file = vehicle_table(path, VEHICLE_DISTURBANCE)
    if not of_file:
        return None
    return parse_table(_Disturbed, {VEHICLE_DISTURBANCE: of_file}, str(path), file="vehicle").disturbance


def preferring_core(scenario: Scenario) -> Scenario:
    """State the core as solver where none is stated and it takes the problem: where the time of a step matters."""
    controller = scenario.controller
    if not isinstance(controller, Bounded) or controller.solver is not None:
        return scenario
    preferred = scenario.replace({"controller.solver": CORE})
    try:
        Assembly(preferred).controller()
    except ParameterError:
        return scenario
    return preferred


def _solver_of(controller: AnyController) -> str | None:
    """Return the solver that a controller's table states; None for none."""
    if isinstance(controller, Bounded):
        return controller.solver
    return None
