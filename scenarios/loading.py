"""Scenario files found, read, changed field by field, and checked."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quadsim.errors import FileError, InputError, ParameterError
from quadsim.flight.phase import AIRBORNE, TOUCH, clearance
from quadsim.sim.airframe import outline
from quadsim.sim.effects.load import Load, mass_properties
from quadsim.sim.rigid_body import check_free
from quadsim.space import Region
from quadsim.state import POSITION
from quadsim.vehicle import Vehicle
from scenarios.courses.csv_course import Csv
from scenarios.limits import space_limits
from scenarios.parts.effects import build_changes, check_changes, moving_air
from scenarios.parts.vehicle import actual_effects, build_actual, build_initial_state, build_vehicle
from scenarios.reference import build_course, build_motion
from scenarios.schema.bases import locate_files, read_scenario, replaced_tables, retyped
from scenarios.schema.problems import ScenarioError
from scenarios.schema.scenario import Scenario
from scenarios.schema.settings import apply_setting
from scenarios.shipped import LIBRARY, scenario_path


def check_parts(scenario: Scenario) -> None:
    """Refuse, before anything is flown, parts that do not go together.

    Raises:
        InputError: there is no such vehicle, it cannot hover, an effect is not possible with it or with the
            integrator, the course cannot be built or does not state the motion that the flight is to start on, or the
            flight starts below the floor, or in the air with rotors at rest.
    """
    vehicle = build_vehicle(scenario)
    actual, effects = build_actual(scenario, vehicle), actual_effects(scenario, vehicle)
    load = effects.load or Load()
    mass_properties(actual, load, load.payloads)
    moving_air(scenario, vehicle)
    changes = build_changes(scenario)
    check_changes(scenario, vehicle, changes)
    if scenario.plant.integrator == "rk4":
        check_free(effects, changes, scenario.obstacles)
    course = build_course(scenario)
    if scenario.initial.on_reference and course.derivatives is None:
        rule = f"false where the course states positions alone, as one of type {scenario.reference.type} does"
        raise ParameterError("initial", "on_reference", True, rule)
    ground = scenario.effects.ground
    if ground is not None and (ground.contact or ground.effect):
        _check_start(scenario, actual)
    if limits := space_limits(scenario):
        start = build_initial_state(scenario, build_motion(scenario, vehicle))[None, list(POSITION)]
        for limit in limits:
            clear = float(limit.shape.clearance(np.zeros(1), start)[0]) - limit.radius
            if limit.start <= 0.0 and clear < -limit.tolerance:
                side = "inside" if isinstance(limit.shape, Region) else "clear of"
                ball = f"the radius of {limit.radius:.3g} m of the ball that represents the vehicle"
                raise ParameterError("initial", "position", start[0].tolist(), f"{side} {limit.name}, by {ball}")


def _check_start(scenario: Scenario, vehicle: Vehicle) -> None:
    """Refuse a start below the floor, or one in the air with rotors at rest."""
    shape, state, position = outline(vehicle), build_initial_state(scenario)[None, :], list(scenario.initial.position)
    feet = float(clearance(state, shape.feet, shape.foot_radius, shape.floor)[0])
    hull = float(clearance(state, shape.hull, 0.0, shape.floor)[0])
    lowest = min(feet, hull)
    if lowest < -TOUCH:
        roll, pitch, _ = scenario.initial.euler
        rule = f"{-lowest:.3g} m higher, at roll {roll:g} and pitch {pitch:g} deg, for feet and hull to clear the floor"
        raise ParameterError("initial", "position", position, rule)
    if scenario.initial.cold and feet > AIRBORNE:
        rule = f"on the floor where initial.cold is true, or it would fall: its feet are {feet:.3g} m above it"
        raise ParameterError("initial", "position", position, rule)


def load_scenario(name: str, settings: Sequence[str] = ()) -> Scenario:
    """Read and check a scenario, merged over its `base` where it has one, with the vehicle and the course it names.

    Settings are `dotted.path=value` texts that replace or add fields, values as in TOML.

    Raises:
        InputError: the file is missing or malformed, a field is not allowed, or what it names cannot be flown so.
    """
    try:
        path = scenario_path(name)
        data = read_scenario(path, scenario_path)
        read = copy.deepcopy(data)
        for setting in settings:
            apply_setting(data, setting)
        try:
            scenario = parse_scenario(data, source=path.name, directory=path.parent)
        except ScenarioError as error:
            raise ScenarioError(path.name, [*error.problems, *_of_types(error.problems, path, read, data)]) from error
        check_parts(scenario)
    except OSError as error:  # of looking whether a file is there, e.g. under a name longer than the system takes
        raise FileError(str(error.filename)[:100], f"cannot be read ({error.strerror})") from error
    return scenario


def as_scenario(
    given: Scenario | str | Path, changes: Mapping[str, Any] | Sequence[str] = (), seed: int | None = None
) -> Scenario:
    """A scenario that is given itself, or by its name or file, with some fields changed; see `scenarios.app.load`."""
    if seed is not None:
        changes = {**changes, "seed": seed} if isinstance(changes, Mapping) else [*changes, f"seed={seed}"]
    if not isinstance(given, str | Path):
        if changes and not isinstance(changes, Mapping):
            raise InputError("changes of a Scenario are a mapping: {'controller.horizon': 30}")
        scenario = given
    elif Path(given).is_dir():
        raise InputError(f"{given} is a directory; give a scenario's name or its TOML file")
    elif not isinstance(changes, Mapping):
        return load_scenario(str(given), changes)
    else:
        scenario = load_scenario(str(given))
    return scenario.replace(changes) if isinstance(changes, Mapping) and changes else scenario


def _of_types(problems: Sequence[str], path: Path, read: Mapping[str, Any], data: Mapping[str, Any]) -> Iterator[str]:
    """Why fields of a table are missing, or are too many: another type was requested than `read` from the file."""
    unfit = (problem for problem in problems if problem.endswith(" is missing") or " is not a field of " in problem)
    wrong = {problem.partition(".")[0] for problem in unfit}
    given = retyped(read, data)
    for name, before in given.items():
        if name in wrong:
            changed = f"--set changed its type from {before!r} to {data[name]['type']!r}, and all other fields stayed"
            base = path.stem if path.parent == LIBRARY else path.name
            yield f'{name}: {changed}; a file with base = "{base}" and a whole [{name}] replaces them'
    missing = {problem.partition(".")[0] for problem in problems if problem.endswith(" is missing")}
    for name, before in replaced_tables(path, scenario_path).items():
        if name in missing - {*given}:
            yield f"{name}: of another type than that of its base ({before}), it replaces it whole and inherits nothing"


def parse_scenario(data: Mapping[str, Any], *, source: str = "scenario", directory: Path | None = None) -> Scenario:
    """Check a scenario given as nested tables, called `source` in messages.

    Relative paths of vehicles and courses, and modules of plug-ins, are looked up in `directory` too.

    Raises:
        ScenarioError: naming every field that is wrong.
        FileError: the course's table is wrong.
    """
    if directory is not None:
        data = {name: {**value} if isinstance(value, dict) else value for name, value in data.items()}
        locate_files(data, directory)
    scenario = Scenario.parse(data, source=source)
    if directory is not None and isinstance(scenario.reference, Csv):
        scenario = scenario.model_copy(update={"reference": scenario.reference.located(directory)})
    return scenario
