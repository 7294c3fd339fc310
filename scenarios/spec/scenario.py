"""The whole scenario file."""

from __future__ import annotations

from typing import Annotated, Final, Literal, get_args

from annotated_types import MaxLen
from pydantic import Field, model_validator

from quadsim.errors import ParameterError
from quadsim.physics import steps_per_period
from scenarios.spec.base import MOST_ENTRIES, Spec
from scenarios.spec.computation import ComputationSpec
from scenarios.spec.constraint import ConstraintSpec
from scenarios.spec.controller import ControllerSpec
from scenarios.spec.course import ReferenceSpec
from scenarios.spec.effects import EffectsSpec
from scenarios.spec.events import Event, PayloadDropEvent, PayloadPickupEvent, SensorFaultEvent
from scenarios.spec.lost import LostSpec
from scenarios.spec.sensors import EstimatorSpec, SensorsSpec, check_sensing
from scenarios.spec.start import InitialSpec, PlantSpec
from scenarios.spec.vehicle import VehicleSpec
from scenarios.writing import to_toml

LONGEST_FLIGHT: Final = 86_400.0
LARGEST_SEED: Final = 2**63 - 1
"""The largest whole number that every reader of TOML takes."""
MOST_STEPS: Final = 10_000_000
"""Physics steps, and planned steps (periods times horizon), that one flight may take: each is held in memory."""


Group = Literal["paper", "courses", "air", "faults", "ground", "sensors", "other"]
Verdict = Literal["satisfied", "violated", "lost"]


class Scenario(Spec):
    """A flight: what flies, where, by which controller, and what is required of it."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9._-]*$", max_length=80)] = Field(
        description="letters a-z, digits and . _ -; names the run's directory"
    )
    description: str = Field(description="one line for `quadsim list`")
    group: Group = Field(default="other", description="where `quadsim list` shows it: " + ", ".join(get_args(Group)))
    expect: Verdict = Field(
        default="satisfied",
        description="its verdict, if all is right: satisfied (flown to its end, every required constraint holds), "
        "violated (one does not, or the vehicle crashes), lost (the flight ends early, by a criterion of [lost] or "
        "otherwise)",
    )
    duration: Annotated[float, Field(gt=0.0, le=LONGEST_FLIGHT)] = Field(
        description="[s] simulated time, a whole number of control periods"
    )
    control_period: Annotated[float, Field(gt=0.0, le=10.0)] = Field(
        description="[s] tau_s, time for which a command is held, a whole number of physics steps"
    )
    seed: Annotated[int, Field(ge=0, le=LARGEST_SEED)] = Field(
        default=0, description="of everything random; recorded with the flight"
    )
    log_rate: Annotated[float, Field(ge=0.01, le=1e6)] = Field(
        default=200.0, description="[Hz] rows of plant.parquet; the audit sees every physics step"
    )
    vehicle: VehicleSpec
    initial: InitialSpec = InitialSpec()
    plant: PlantSpec = PlantSpec()
    reference: ReferenceSpec
    controller: ControllerSpec
    effects: EffectsSpec = EffectsSpec()
    computation: ComputationSpec | None = Field(default=None, description="absent: commands take no time")
    sensors: SensorsSpec | None = Field(default=None, description="absent: the controller is told the true state")
    estimator: EstimatorSpec | None = Field(
        default=None, description="absent: the controller is told what the sensors say, as it arrives"
    )
    events: Annotated[list[Event], MaxLen(MOST_ENTRIES)] = Field(default=[], description="what happens on the way")
    lost: LostSpec = LostSpec()
    constraints: Annotated[list[ConstraintSpec], MaxLen(MOST_ENTRIES)] = Field(
        default=[], description="what the flight is audited against; signals and their units are those of the audit"
    )

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
        self._check_events()
        if self.initial.cold and not (self.effects.ground is not None and self.effects.ground.contact):
            raise ValueError("initial.cold must be false where effects.ground gives no floor to stand on; got true")
        check_sensing(self.sensors, self.estimator, timestep=self.plant.timestep)
        names = [constraint.name for constraint in self.constraints]
        if len(set(names)) < len(names):
            raise ValueError(f"constraints must have distinct names; got {names}")
        return self

    def _check_events(self) -> None:
        carried = len(self.effects.load.payloads) if self.effects.load is not None else 0
        for i, event in sorted(enumerate(self.events), key=lambda entry: entry[1].at):
            if event.at >= self.duration:
                raise ValueError(f"events.{i}.at must be before the flight's end, {self.duration} s; got {event.at}")
            if isinstance(event, PayloadPickupEvent):
                carried += 1
            elif isinstance(event, PayloadDropEvent):
                if not carried:
                    raise ValueError(f"events.{i}.type must not be payload_drop at {event.at} s: nothing is carried")
                carried = 0
            elif isinstance(event, SensorFaultEvent) and self.estimator is not None:
                present = [] if self.sensors is None else [str(name) for name in self.sensors.present()]
                if event.sensor not in present:
                    rule = f"one that the estimator has, of {', '.join(present)}"
                    raise ValueError(f"events.{i}.sensor must be {rule}; got {event.sensor!r}")

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
        """The resolved file: every field, defaults included, with comments; parsing it gives this scenario again."""
        return to_toml(self)
