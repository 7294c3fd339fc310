"""The scenario file: what it may say, checked field by field."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Final, Literal

import tomli_w
from annotated_types import Len
from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag, model_validator

from mpc.solvers import SOLVERS
from quadsim.audit import SIGNALS
from quadsim.errors import ParameterError, UnknownNameError
from quadsim.plant import steps_per_period
from quadsim.state import STATE_NAMES, STATE_UNITS

LARGEST_HORIZON: Final = 1000
LONGEST_FLIGHT: Final = 86_400.0
MOST_STEPS: Final = 10_000_000
"""Physics steps, and planned steps (periods times horizon), that one flight may take: each is held in memory."""

Number = Annotated[float, Field(ge=-1e6, le=1e6)]
Weight = Annotated[float, Field(gt=0.0, le=1e12)]
Triple = Annotated[list[Number], Len(3, 3)]
Quadruple = Annotated[list[Number], Len(4, 4)]
Pair = Annotated[list[Number], Len(2, 2)]


def _number_or_list(value: object) -> str:
    return "list" if isinstance(value, list) else "number"


Weights = Annotated[
    Annotated[Weight, Tag("number")] | Annotated[list[Weight], Len(4, 4), Tag("list")], Discriminator(_number_or_list)
]
"""One weight for all rotors, or one each."""


class _Spec(BaseModel):
    """A table of the file.

    What a validator raises starts with the name of the field, for `scenarios.problems.describe` to complete.
    """

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


def _require_ordered(name: str, pair: Sequence[float]) -> None:
    if not pair[0] < pair[1]:
        raise ValueError(f"{name} must have its lower bound below its upper; got {list(pair)}")


class VehicleSpec(_Spec):
    """Which vehicle file, and what in it to replace; units as in the file."""

    file: str = Field(description="a shipped vehicle's name, or a path ending in .toml, relative to the scenario file")
    mass: float | None = None
    gravity: float | None = None
    inertia: Triple | None = None
    arm_length: float | None = None
    rotor_azimuths: Quadruple | None = None
    rotor_spins: Annotated[list[int], Len(4, 4)] | None = None
    thrust_coefficient: float | None = None
    drag_to_thrust: float | None = None
    speed_min: float | None = None
    speed_max: float | None = None

    def overrides(self) -> dict[str, Any]:
        """The parameters that replace the file's."""
        return self.model_dump(exclude={"file"}, exclude_none=True)


class InitialSpec(_Spec):
    """Where the flight starts, at rest; the command before the first is hover."""

    position: Triple = Field(default=[0.0, 0.0, 0.0], description="x, y, z [m], world")
    euler: Triple = Field(default=[0.0, 0.0, 0.0], description="roll, pitch, yaw [deg]")

    @model_validator(mode="after")
    def _check(self) -> InitialSpec:
        if any(abs(angle) >= 90.0 for angle in self.euler[:2]):
            raise ValueError(f"euler must have roll and pitch within +-90 deg; got {self.euler}")
        return self


class PlantSpec(_Spec):
    """The simulated vehicle."""

    timestep: Annotated[float, Field(ge=1e-6, le=0.01, description="physics step [s]")] = 1e-3
    limit_speeds: bool = Field(default=False, description="whether rotors saturate at the vehicle's speed range")


class WindowSpec(_Spec):
    """A value held strictly between two instants.  Eq. (30)."""

    start: Number = Field(description="[s]")
    stop: Number = Field(description="[s]")
    value: Number = Field(description="[m], or [deg] for yaw")

    @model_validator(mode="after")
    def _check(self) -> WindowSpec:
        if not self.start < self.stop:
            raise ValueError(f"start must be below stop = {self.stop}; got {self.start}")
        return self


class ReferenceSpec(_Spec):
    """The desired course; outside its windows an axis stays at its initial position, and yaw at 0."""

    response_time: Annotated[float, Field(ge=0.0, description="tau_r [s] of Eq. (31); 0 for no filter")] = 0.0
    x: list[WindowSpec] = []
    y: list[WindowSpec] = []
    z: list[WindowSpec] = []
    yaw: list[WindowSpec] = []


class InputWeightsSpec(_Spec):
    """Diagonal of Q_u."""

    speed: Weights


class InputBoundsSpec(_Spec):
    """Hard bounds on the rotor speeds and their steps, for every rotor."""

    speed: Pair = Field(description="u_min, u_max [rad/s].  Eq. (20)")
    slew: Pair = Field(description="delta_min, delta_max [rad/s per period].  Eq. (15)")

    @model_validator(mode="after")
    def _check(self) -> InputBoundsSpec:
        _require_ordered("speed", self.speed)
        _require_ordered("slew", self.slew)
        if self.speed[0] < 0.0:
            raise ValueError(f"speed must have a lower bound >= 0 rad/s; got {self.speed}")
        if not self.slew[0] <= 0.0 <= self.slew[1]:
            raise ValueError(f"slew must allow a speed to be held, so contain 0; got {self.slew}")
        return self


def _known_states(values: Mapping[str, object], name: str) -> None:
    for key in values:
        if key not in STATE_NAMES:
            near = difflib.get_close_matches(key, STATE_NAMES, n=1)
            guess = f"; did you mean {near[0]!r}?" if near else ""
            raise ValueError(f"{name}.{key} is not a state{guess} (there are: {', '.join(STATE_NAMES)})")


class _ControllerSpec(_Spec):
    horizon: Annotated[int, Field(ge=1, le=LARGEST_HORIZON, description="N, control periods")]
    output_weights: Annotated[dict[str, Weight], Len(1)] = Field(description="C_r by its keys, diagonal of Q_y")
    input_weights: InputWeightsSpec

    @model_validator(mode="after")
    def _check_outputs(self) -> _ControllerSpec:
        _known_states(self.output_weights, "output_weights")
        return self


class UnconstrainedSpec(_ControllerSpec):
    """The paper's Sec. 4."""

    type: Literal["unconstrained"]


class ConstrainedSpec(_ControllerSpec):
    """The paper's Sec. 5."""

    type: Literal["constrained"]
    solver: str = Field(default="piqp-multistage", description="a name from `quadsim list`")
    shortcut: bool = Field(
        default=True, description="take the unconstrained optimum where no constraint bars it; exact"
    )
    output_bounds: dict[str, Pair] = Field(default={}, description="C_c by its keys; deg for angles, deg/s for rates")
    input_bounds: InputBoundsSpec

    @model_validator(mode="after")
    def _check(self) -> ConstrainedSpec:
        _known_states(self.output_bounds, "output_bounds")
        for name, pair in self.output_bounds.items():
            _require_ordered(f"output_bounds.{name}", pair)
        if self.solver not in SOLVERS:
            raise ValueError(f"solver: {UnknownNameError('solver', self.solver, SOLVERS)}")
        return self


class ConstraintSpec(_Spec):
    """What the flight is audited against; see `quadsim.audit.Limit`."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]+$")]
    signal: str
    lower: Number | None = None
    upper: Number | None = None
    tolerance: Annotated[float, Field(ge=0.0, le=1e6, description="at the physics rate")] = 0.0
    tolerance_sampled: Annotated[float, Field(ge=0.0, le=1e6, description="at the control samples")] = 0.0
    required: bool = Field(default=True, description="false: measured and reported, never a failure")
    start: Number = Field(default=0.0, description="first time it holds [s]")
    stop: Number | None = Field(default=None, description="last time it holds [s]")

    @model_validator(mode="after")
    def _check(self) -> ConstraintSpec:
        if self.signal not in SIGNALS:
            raise ValueError(f"signal: {UnknownNameError('signal', self.signal, SIGNALS)}")
        if self.lower is None and self.upper is None:
            raise ValueError("lower must be given, or upper, or both")
        if self.lower is not None and self.upper is not None and self.lower >= self.upper:
            raise ValueError(f"lower must be below upper = {self.upper}; got {self.lower}")
        if self.tolerance_sampled > self.tolerance:
            raise ValueError(
                f"tolerance_sampled must be at most tolerance = {self.tolerance}; got {self.tolerance_sampled}"
            )
        if self.stop is not None and self.stop < self.start:
            raise ValueError(f"stop must be at least start = {self.start}; got {self.stop}")
        return self


class Scenario(_Spec):
    """A whole scenario file."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9._-]*$", max_length=80)]
    description: str
    duration: Annotated[float, Field(gt=0.0, le=LONGEST_FLIGHT, description="[s]")]
    control_period: Annotated[float, Field(gt=0.0, le=10.0, description="tau_s [s]")]
    seed: Annotated[int, Field(ge=0)] = 0
    log_rate: Annotated[float, Field(ge=0.01, le=1e6, description="rows of plant.parquet per second [Hz]")] = 200.0
    vehicle: VehicleSpec
    initial: InitialSpec = InitialSpec()
    plant: PlantSpec = PlantSpec()
    reference: ReferenceSpec
    controller: Annotated[UnconstrainedSpec | ConstrainedSpec, Field(discriminator="type")]
    constraints: list[ConstraintSpec] = []

    @model_validator(mode="after")
    def _check(self) -> Scenario:
        for name, value, unit in (
            ("control_period", self.control_period, self.plant.timestep),
            ("duration", self.duration, self.control_period),
            ("log_rate", 1.0 / self.log_rate, self.plant.timestep),
        ):
            try:
                steps_per_period(value, unit)
            except ParameterError as error:
                what = "the control period" if name == "duration" else "the physics step plant.timestep"
                given = self.log_rate if name == "log_rate" else value
                period = "have a period that is" if name == "log_rate" else "be"
                raise ValueError(f"{name} must {period} a whole multiple of {what} = {unit} s; got {given}") from error
        for what, count in (
            ("physics steps", self.periods * self.steps_per_period),
            ("planned steps", self.periods * self.controller.horizon),
        ):
            if count > MOST_STEPS:
                raise ValueError(f"duration must make at most {MOST_STEPS} {what}; got {count} of them")
        names = [constraint.name for constraint in self.constraints]
        if len(set(names)) < len(names):
            raise ValueError(f"constraints must have distinct names; got {names}")
        return self

    @property
    def periods(self) -> int:
        """K, control periods in the flight."""
        return steps_per_period(self.duration, self.control_period)

    @property
    def steps_per_period(self) -> int:
        """Physics steps per control period."""
        return steps_per_period(self.control_period, self.plant.timestep)

    @property
    def plant_stride(self) -> int:
        """Physics steps per row of `plant.parquet`."""
        return steps_per_period(1.0 / self.log_rate, self.plant.timestep)

    def to_toml(self) -> str:
        """The resolved file: every field, defaults included; parsing it gives this scenario again."""
        return tomli_w.dumps(self.model_dump(exclude_none=True))


ANGLES: Final = frozenset(name for name, unit in zip(STATE_NAMES, STATE_UNITS, strict=True) if unit.startswith("rad"))
"""States that scenario files give in degrees (per second)."""
