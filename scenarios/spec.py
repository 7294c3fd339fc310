"""The scenario file: what it may say, checked field by field."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Literal, get_args

import tomli_w
from annotated_types import Len
from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag, ValidationError, model_validator
from pydantic_core import ErrorDetails

from mpc.solvers import SOLVERS
from quadsim.audit import SIGNALS
from quadsim.errors import FileError, InputError, ParameterError, UnknownNameError
from quadsim.plant import steps_per_period
from quadsim.state import STATE_NAMES, STATE_UNITS

LIBRARY: Final = Path(__file__).resolve().parent / "library"
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


class ScenarioError(InputError):
    """A scenario file that cannot be flown.

    Attributes:
        problems: one line per field, each naming it, what was given and what is allowed.
    """

    def __init__(self, source: str, problems: Sequence[str]) -> None:
        super().__init__(f"{source}: " + "\n  ".join(problems))
        self.source, self.problems = source, tuple(problems)


class _Spec(BaseModel):
    """A table of the file.  What a validator raises starts with the name of the field, for `_describe` to complete."""

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


def scenario_names() -> list[str]:
    """Names of the scenarios that ship, sorted."""
    return sorted(path.stem for path in LIBRARY.glob("*.toml"))


def scenario_path(name: str) -> Path:
    """The file of a library name, or the path itself when it ends in `.toml`.

    Raises:
        FileError, UnknownNameError: there is none.
    """
    if name.endswith(".toml"):
        if not Path(name).is_file():
            raise FileError(name, "no such scenario file")
        return Path(name)
    if name not in scenario_names():
        raise UnknownNameError("scenario", name, scenario_names(), hint="or give a path ending in .toml")
    return LIBRARY / f"{name}.toml"


def load_scenario(name: str, settings: Sequence[str] = ()) -> Scenario:
    """Read and check a scenario.

    Args:
        name: a library name, or a path ending in `.toml`.
        settings: `dotted.path=value` texts that replace or add fields, values as in TOML.

    Raises:
        InputError: the file is missing or malformed, or a field is not allowed.
    """
    path = scenario_path(name)
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(path, f"cannot be read ({error})") from error
    except tomllib.TOMLDecodeError as error:
        raise FileError(path, f"is not valid TOML: {error}") from error
    for setting in settings:
        apply_setting(data, setting)
    return parse_scenario(data, source=path.name, directory=path.parent)


def parse_scenario(data: Mapping[str, Any], *, source: str = "scenario", directory: Path | None = None) -> Scenario:
    """Check a scenario given as nested tables.

    Args:
        data: the parsed TOML.
        source: what to call it in messages.
        directory: where relative vehicle paths are looked up, besides the working directory.

    Raises:
        ScenarioError: naming every field that is wrong.
    """
    try:
        scenario = Scenario.model_validate(dict(data))
    except ValidationError as error:
        problems = [_describe(details, data) for details in error.errors(include_url=False)]
        raise ScenarioError(source, problems) from error
    file = scenario.vehicle.file
    if directory is not None and file.endswith(".toml") and (directory / file).is_file():
        absolute = str((directory / file).resolve())
        scenario = scenario.model_copy(update={"vehicle": scenario.vehicle.model_copy(update={"file": absolute})})
    return scenario


def apply_setting(data: dict[str, Any], setting: str) -> None:
    """Apply one `dotted.path=value` to a scenario's tables; entries of `constraints` are addressed by their name.

    Raises:
        ParameterError: the text is not of that form, or the path goes through something that is no table.
    """
    path, equals, text = setting.partition("=")
    keys = path.strip().split(".")
    if not equals or not all(keys):
        raise ParameterError("", "--set", setting, "of the form dotted.path=value")
    try:
        value: Any = tomllib.loads(f"value = {text.strip()}")["value"]
    except tomllib.TOMLDecodeError:
        value = text.strip()
    table: Any = data
    for depth, key in enumerate(keys):
        if isinstance(table, list):
            named = [entry for entry in table if isinstance(entry, dict) and entry.get("name") == key]
            if not named:
                allowed = [str(entry.get("name")) for entry in table if isinstance(entry, dict)]
                raise UnknownNameError(f"entry of {'.'.join(keys[:depth])}", key, allowed)
            table = named[0]
        elif not isinstance(table, dict):
            raise ParameterError("", "--set", setting, f"a path to a field; {keys[depth - 1]} has none")
        elif depth == len(keys) - 1:
            table[key] = value
        else:
            table = table.setdefault(key, {})


def _describe(details: ErrorDetails, data: Mapping[str, Any]) -> str:
    """One line about one field: its name, what is allowed, what was given."""
    location = _location(details["loc"], data)
    field = ".".join(location)
    kind, given, context = details["type"], details["input"], details.get("ctx", {})
    if kind.startswith("union_tag"):
        given = given.get("type") if isinstance(given, dict) else given
    if kind == "missing":
        return f"{'.'.join([*location, str(details['loc'][-1])])} is missing"
    if kind == "extra_forbidden":
        allowed = _siblings(details["loc"][:-1])
        near = difflib.get_close_matches(location[-1], allowed, n=1)
        guess = f"; did you mean {near[0]!r}?" if near else ""
        return f"{field} is not a field of the scenario file{guess} (there are: {', '.join(allowed)})"
    if kind == "value_error":
        return ".".join([*location, str(context["error"])])
    rules = {
        "greater_than": "> {gt}",
        "greater_than_equal": ">= {ge}",
        "less_than_equal": "<= {le}",
        "finite_number": "a finite number",
        "float_type": "a number",
        "int_type": "a whole number",
        "string_type": "a text",
        "bool_type": "true or false",
        "list_type": "a list",
        "dict_type": "a table",
        "model_type": "a table",
        "model_attributes_type": "a table",
        "too_short": "of {min_length} or more entries",
        "too_long": "of {max_length} or fewer entries",
        "string_pattern_mismatch": "of the form {pattern}",
        "union_tag_invalid": "one of {expected_tags} in its field type",
        "union_tag_not_found": "a table with a field type",
    }
    rule = rules[kind].format(**context) if kind in rules else details["msg"]
    return f"{field} must be {rule}; got {given!r}"


def _location(path: Sequence[int | str], data: Any) -> list[str]:
    """Names from the root to a field: pydantic's path less its labels of union members, a named entry by its name."""
    names: list[str] = []
    for part in path:
        if isinstance(part, int):
            data = data[part]
            name = data.get("name") if isinstance(data, dict) else None
            names.append(name if isinstance(name, str) else str(part))
        elif isinstance(data, Mapping) and part in data:
            data = data[part]
            names.append(part)
    return names


def _siblings(path: Sequence[int | str]) -> list[str]:
    """Field names allowed at a place in the file, for guessing what was meant."""
    models: list[type[BaseModel]] = [Scenario]
    for part in path:
        inner = [
            model
            for outer in models
            if part in outer.model_fields
            for model in _models_in(outer.model_fields[str(part)].annotation)
        ]
        tagged = [
            model
            for model in models
            if "type" in model.model_fields and part in get_args(model.model_fields["type"].annotation)
        ]
        models = inner or tagged or models
    return list(dict.fromkeys(name for model in models for name in model.model_fields))


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for argument in getattr(annotation, "__args__", ()) for model in _models_in(argument)]
