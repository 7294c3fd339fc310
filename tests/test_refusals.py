"""Wrong input is refused at the front door by one message that names file, field, what was given, what is allowed.

The declarations drive the first tests: they put values of every type into every field of a scenario, campaign or
vehicle file, and a file is accepted or refused as the field's schema says.  The messages that are written out below
show rules between fields.
"""

from __future__ import annotations

import math
import os
import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass
from datetime import date
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import pytest
import tomlkit
from jsonschema import Draft202012Validator

from quadsim.assets import vehicle_path
from quadsim.commands.cli import main
from quadsim.errors import InputError
from quadsim.features.campaign.campaign_file import CampaignFile
from quadsim.features.campaign.plan import load_plan, parse_campaign, read_campaign
from quadsim.fields import floor_of
from quadsim.mpc.laws import laws
from quadsim.scenarios.catalogue import campaign_names, scenario_names
from quadsim.scenarios.loading import load_scenario, parse_scenario
from quadsim.scenarios.schema.base import fields_of
from quadsim.scenarios.schema.bases import read_scenario
from quadsim.scenarios.schema.json_schema import scenario_schema
from quadsim.scenarios.schema.problems import adapter, kinds_of
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.scenarios.schema.settings import apply_setting
from quadsim.scenarios.schema.writing import tables_in
from quadsim.vehicle import VEHICLE_UNITS, load_vehicle

FILE = "mine.toml"
WORDS = ("default", "description", "title")
"""The keys of a schema that do not change what it allows."""
JUNK = ("junk", "", True, math.nan, -math.inf, -1, 0, 1e300, date(2024, 1, 31), [], [[["junk"]]], {}, {"junk": 1})
"""A value of every type, and numbers that few fields allow; the first is tried in every field."""
LINES = (
    re.compile(r"(?P<field>\S+) must be .+; got (?P<got>.+)"),
    re.compile(r"(?P<field>\S+) is not a field of the \w+ file.* \(there are: .+\)"),
    re.compile(r"(?P<field>\S+) is missing"),
    re.compile(r"(?P<field>\S+): no \w+ named .+ \(there are .+\)"),
)
"""The forms of a message's line about a field that its declaration does not allow."""
RULE = re.compile(r"must (not |all )?(be|have) |is missing|is not a |no \w+ named ")
"""What a message says about a field that its declaration allows, but not beside the other fields of the file."""

EVENTS = """[
    {at=1, type='wind', velocity=[1, 0, 0]}, {at=1, type='rotor_lag', rise=0.05}, {at=1, type='mass', factor=1.1},
    {at=1, type='push', duration=1, force=[1, 0, 0]}, {at=1, type='setpoint', x=1},
    {at=1, type='controller', fields={horizon=21}},
]"""
OBSTACLES = """[
    {type='box', name='a', position=[9, 9, 9], size=[1, 1, 1], path=[{time=1, position=[9, 9, 8]}]},
    {type='capsule', name='b', position=[9, 9, 9], radius=1, axis=[0, 0, 1]},
]"""
BESIDES = (
    ("effects.air.rotor_drag=1e-4", "effects.rotors={rise=0.05, fall=0.05}", f"events={EVENTS}"),
    ("controller={type='pid'}", "actual.mass=4.2", "keep_in={position=[0, 0, 1], size=[9, 9, 9]}"),
    ("controller={type='lqr', output_weights={z=1}, input_weights={speed=1}}", f"obstacles={OBSTACLES}"),
    (
        "controller={type='robust', commands='rates', horizon=9, output_weights={x=1}, target_weights={thrust=1,"
        " body_rate=1}}",
        "autopilot={}",
    ),
    ("controller={type='m:Law'}", "forces=[{type='m:force'}]"),
    ("recorded={file='lopes2011'}",),
)
"""Settings of `hover` for the tables that no file of the library has."""
CAMPAIGN = """
name = "c"
scenario = "hover"
flights = 4
vary = [{name = "mass", fields = ["effects.load.mass_factor"], distribution = "uniform", low = 0.9, high = 1.1}]
"""
DISTRIBUTIONS = """
vary = [
    {name = "a", fields = ["seed.a"], distribution = "log_uniform", low = 0.9, high = 1.1},
    {name = "b", fields = ["seed.b"], distribution = "normal", mean = 1.0, deviation = 0.1, low = 0.0, high = 2.0},
    {name = "c", fields = ["seed.c"], distribution = "integer", low = 1, high = 3},
    {name = "d", fields = ["seed.d"], distribution = "choice", values = [1.0, 2.0], weights = [1.0, 1.0]},
    {name = "e", fields = ["seed.e"], distribution = "grid", values = [1.0, 2.0]},
]
"""


def refusal(load: Callable[[], object]) -> str:
    """The message by which a file is refused as wrong input, or `accepted`."""
    try:
        load()
    except InputError as error:
        if error.exit_status != 2:
            return f"exit status {error.exit_status}"
        return str(error)
    return "accepted"


def matches(message: str, expected: str) -> bool:
    """Whether a message is the expected one, in which @ stands for anything."""
    parts = [re.escape(part) for part in expected.split("@")]
    return re.fullmatch(".*".join(parts), message, re.DOTALL) is not None


# --- any field, anything in it -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Kind:
    """A kind of file: its declaration, how it is read, and the valid files in which every table occurs."""

    root: type[Any]
    schema: dict[str, Any]
    parse: Callable[[dict[str, Any]], Any]
    files: Sequence[dict[str, Any]]

    @cached_property
    def tables(self) -> set[type[Any]]:
        """Every table class that such a file may have."""
        tables: set[type[Any]] = set()
        to_visit = [self.root]
        while to_visit:
            table = to_visit.pop()
            if table not in tables:
                tables.add(table)
                for declared in fields_of(table).values():
                    to_visit += tables_in(declared.annotation)
        return tables

    def properties(self, table: type[Any]) -> tuple[dict[str, Any], set[str]]:
        """The schemas of a table's fields by name, and the names of those that must be there."""
        stated = self.schema if table is self.root else self.schema["$defs"][table.__name__]
        return stated["properties"], {*stated.get("required", ())}


def scenario_kind() -> Kind:
    """The scenarios of the library and of `BESIDES`; short ones first, as they are read in less time."""
    whole = scenario_schema()
    schema = {**whole["else"], "$defs": whole["$defs"]}  # of a file without a base
    files = [read_scenario(name) for name in scenario_names()]
    for settings in BESIDES:
        file = read_scenario("hover")
        for setting in settings:
            apply_setting(file, setting)
        files.append(file)
    files.sort(key=lambda data: len(str(data)))
    return Kind(Scenario, schema, lambda data: parse_scenario(data, source=FILE), files)


def campaign_kind() -> Kind:
    """The campaigns of the library, and one with every distribution."""
    files = [read_campaign(name) for name in campaign_names()]
    without_vary, _, _ = CAMPAIGN.partition("vary")
    files.append(tomllib.loads(without_vary + DISTRIBUTIONS))
    schema = adapter(CampaignFile).json_schema()
    return Kind(CampaignFile, schema, lambda data: parse_campaign(data, source=FILE), files)


KINDS = {kind.root.__name__: kind for kind in (scenario_kind(), campaign_kind())}


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], type[Any]]]:
    """The paths to the tables of a file that was read, each with its class."""
    items: Iterable[tuple[Any, Any]] = ()
    if is_dataclass(value):
        yield path, type(value)
        items = [(name, getattr(value, name)) for name in fields_of(type(value))]
    elif isinstance(value, dict):
        items = value.items()
    elif isinstance(value, list | tuple):
        items = enumerate(value)
    for key, entry in items:
        yield from places(entry, (*path, key))


def inside(data: dict[str, Any], path: Sequence[Any]) -> tuple[dict[str, Any], list[str]]:
    """The table at a path, and the words of the path in messages; a table that the file leaves out is made."""
    names = []
    holder: Any = data
    for part in path:
        if isinstance(part, str):
            holder = holder.setdefault(part, {})
            names.append(part)
        else:
            holder = holder[part]
            names.append(holder.get("name", str(part)))
    return holder, names


def reread(kind: Kind, data: dict[str, Any]) -> None:
    """Read a file, write it, and read it again, which gives the same file."""
    file = kind.parse(data)
    assert kind.parse(tomllib.loads(file.to_toml())) == file


def edits(table: dict[str, Any], field: str, junk: Sequence[Any]) -> Iterator[tuple[Any, bool]]:
    """Put each junk value into a field, then every third into the first entry of its list; the table is restored.

    Yields:
        The junk value, and whether it stands for the whole field.
    """
    before = table.get(field)
    for value in junk:
        table[field] = value
        yield value, True
    if isinstance(before, list) and before:
        for value in junk[::3]:
            table[field] = [value, *before[1:]]
            yield value, False
    del table[field]
    if before is not None:
        table[field] = before


def is_plain(value: Any) -> bool:
    """Whether JSON has such a value."""
    if isinstance(value, dict):
        return all(map(is_plain, value.values()))
    if isinstance(value, list):
        return all(map(is_plain, value))
    if isinstance(value, float):
        return math.isfinite(value)
    return not isinstance(value, date)


def shown(value: Any) -> str:
    """A value as messages show it."""
    if isinstance(value, date):
        return value.isoformat()
    return repr(value)


def complaints(message: str, field: str, given: str | None) -> list[str]:
    """What is wrong with a message about a field whose value its declaration does not allow.

    Args:
        message: what refused the file.
        field: its path.
        given: the value as messages show it; None: it is inside a list.
    """
    if not message.startswith(f"{FILE}: "):
        return [f"names no file: {message}"]
    wrong = []
    for line in message.removeprefix(f"{FILE}: ").split("\n  "):
        words = words_of(line)
        if not words.get("field", "").startswith(field):
            wrong.append(f"is not about {field}: {line}")
        elif given is not None and words["field"] == field and not words.get("got", given).startswith(given):
            wrong.append(f"does not show {given}: {line}")
    return wrong


def words_of(line: str) -> dict[str, str]:
    """The field that a line names and, in some forms, what was given; nothing if it has none of the forms `LINES`."""
    for form in LINES:
        match = form.fullmatch(line)
        if match is not None:
            return match.groupdict()
    return {}


@dataclass(kw_only=True)
class Tally:
    """What has been tried of one kind of file."""

    wrong: list[str] = field(default_factory=list)  # messages that do not say what they should
    declarations: set[str] = field(default_factory=set)  # of fields, tried with all values
    accepted: int = 0  # values that a field allows


def try_table(kind: Kind, data: dict[str, Any], path: Sequence[Any], table: type[Any], tally: Tally) -> None:
    """Put an unknown field into a table of a file, then wrong and right values into each of its fields."""
    holder, names = inside(data, path)
    properties, required = kind.properties(table)
    assert properties.keys() == fields_of(table).keys()
    holder["junk"] = 1
    tally.wrong += complaints(refusal(partial(kind.parse, data)), ".".join([*names, "junk"]), None)
    del holder["junk"]
    for name, schema in properties.items():
        owner = names
        if name == "name":  # a table whose name is wrong is called by its number
            owner = [str(part) for part in path]
        named = ".".join([*owner, name])
        try_values(kind, data, holder, name, schema, named, tally)
        if name in required - {"type", "distribution"}:
            value = holder.pop(name)
            message = refusal(partial(kind.parse, data))
            if message != f"{FILE}: {named} is missing":
                tally.wrong.append(message)
            holder[name] = value


def try_values(
    kind: Kind,
    data: dict[str, Any],
    holder: dict[str, Any],
    name: str,
    schema: dict[str, Any],
    named: str,
    tally: Tally,
) -> None:
    """Put values into a field, which messages call `named`.

    The first field of a declaration is tried with all of `JUNK`, other fields of the same declaration with one value.
    """
    allows = Draft202012Validator({**schema, "$defs": kind.schema["$defs"]}).is_valid
    declaration = str({key: value for key, value in schema.items() if key not in WORDS})
    junk_values: Sequence[Any] = JUNK
    if declaration in tally.declarations:
        junk_values = JUNK[:1]
    tally.declarations.add(declaration)
    for junk, whole in edits(holder, name, junk_values):
        message = refusal(partial(reread, kind, data))
        if not (is_plain(holder[name]) and allows(holder[name])):
            given = shown(junk) if whole else None
            tally.wrong += complaints(message, named, given)
        elif message != "accepted" and not RULE.search(message):
            tally.wrong.append(message)
        else:
            tally.accepted += 1


@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS.keys())
def test_a_field_is_accepted_as_declared_or_named_with_what_was_given_and_what_is_allowed(kind: Kind) -> None:
    tally = Tally()
    tried: set[type[Any]] = set()
    for data in kind.files:
        for path, table in places(kind.parse(data)):
            if table not in tried:
                tried.add(table)
                try_table(kind, data, path, table, tally)
    assert not tally.wrong, "\n".join(tally.wrong)
    missing = [table.__name__ for table in kind.tables - tried]
    assert tried == kind.tables, f"in no scenario of the library, and in no line of BESIDES: {missing}"
    assert tally.accepted > 0


def limits_of_numbers(table: type[Any]) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    """The name, the unit and the limits of each number in the fields of a table."""
    for name, declared in fields_of(table).items():
        stated = re.match(r"\[([^\]]+)\]", declared.description or "")
        unit = stated[1] if stated else ""
        for allowed in kinds_of(declared.annotation, tuple(declared.metadata)):
            for number in (allowed, *allowed.entries):
                if number.type is float:
                    yield f"{table.__name__}.{name}", unit, number.limits


@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS.keys())
def test_what_must_be_positive_has_the_floor_of_its_unit(kind: Kind) -> None:
    """A quotient by the least number does not overflow; shares and angles alone may be as small as they like."""
    positive = 0
    for table in kind.tables:
        for name, unit, limits in limits_of_numbers(table):
            least = limits.get("ge", 0.0)
            if limits.get("gt") == 0.0:
                positive += 1
                assert unit in ("-", "deg"), name
            elif 0.0 < least < 1e-3:
                positive += 1
                assert least >= floor_of(unit), name
    assert positive > 0


@pytest.mark.parametrize("name", VEHICLE_UNITS)
def test_a_number_of_a_vehicle_is_accepted_as_declared_or_named_with_what_was_given(name: str, tmp_path: Path) -> None:
    path = tmp_path / FILE
    text = vehicle_path("lopes2011").read_text(encoding="utf-8")
    may_be_zero = name in ("speed_min", "inflow", "throttle_offset")
    for junk in JUNK[::2]:
        entry = {"unit": VEHICLE_UNITS[name], "source": "a guess", "value": junk}
        path.write_text(tomlkit.dumps(tomllib.loads(text) | {name: entry}), encoding="utf-8")
        message = refusal(lambda: load_vehicle(path))
        if may_be_zero and type(junk) is int and junk == 0:
            assert message == "accepted"
        else:
            assert re.fullmatch(rf".*/{FILE}: vehicle\.{name}(\.\d)? must be .+; got .+", message), (junk, message)


@pytest.mark.parametrize("name", VEHICLE_UNITS)
def test_a_number_of_a_vehicle_has_its_unit_and_a_source(name: str, tmp_path: Path) -> None:
    path = tmp_path / FILE
    text = vehicle_path("lopes2011").read_text(encoding="utf-8")
    unit = VEHICLE_UNITS[name]
    for entry, wrong in (
        ("junk", ""),
        ({}, ""),
        ({"value": 1.0, "unit": "furlong", "source": "x"}, r"\.unit"),
        ({"value": 1.0, "unit": unit, "source": ""}, r"\.source"),
    ):
        path.write_text(tomlkit.dumps(tomllib.loads(text) | {name: entry}), encoding="utf-8")
        message = refusal(lambda: load_vehicle(path))
        assert re.match(rf".*/{FILE}: vehicle\.{name}{wrong} must be ", message), message


# --- messages, written out -----------------------------------------------------------------------------------------


def vary(ends: str, field: str = "effects.load.mass_factor") -> str:
    """The line of a campaign that draws a field uniformly."""
    return f"vary = [{{name='mass', fields=['{field}'], distribution='uniform', {ends}}}]"


def load_course(path: Path, text: str) -> None:
    """Write a table of samples and load a scenario that follows it."""
    path.write_text(text, encoding="utf-8")
    load_scenario("hover", [f"reference={{type='csv', file='{path}'}}"])


def load_file(path: Path, text: str) -> None:
    """Write a scenario and load it, beside one, y.toml, whose base is missing."""
    path.with_name("y.toml").write_text('base = "gone.toml"')
    path.write_text(text, encoding="utf-8")
    load_scenario(str(path))


def load_edited(path: Path, edit: str) -> None:
    """Load a vehicle's file after an edit, `old => new`."""
    old, _, new = edit.partition(" => ")
    text = vehicle_path("lopes2011").read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    load_vehicle(path)


def load_campaign(path: Path, change: str) -> None:
    """Load `CAMPAIGN` with another line in the place of the one that states the same field."""
    field, _, _ = change.partition(" = ")
    kept = [line for line in CAMPAIGN.splitlines() if not line.startswith(f"{field} = ")]
    path.write_text("\n".join([*kept, change]))
    load_plan(str(path))


SEED = "must be a whole number >= 0 and <= 9223372036854775807"
NESTED = "--set must be of at most 20 tables and lists within one another@"
LAWS = ", ".join(repr(name) for name in (*laws(), "package.module:Class"))
DRAGLESS = (
    "effects.air.rotor_drag must be positive, or body_drag given, for the wind to push: the vehicle 'lopes2011' states "
    "no drag; got 0.0"
)
MISTAKES = {  # settings of `hover`, and the messages for them
    "controller.horizn=3": "controller.horizn is not a field of the scenario file; did you mean 'horizon'?@",
    "controller=lqt": f"controller.type must be one of {LAWS}; got 'lqt'; did you mean 'lqr'?",
    "controller.compiled=true": "controller.compiled must be left out, as it went (C always prepares the queries of "
    "robust, @; got True",
    "events=[{type='controller', at=1, fields={compiled=false}}]": "events.0.fields: controller.compiled must be "
    "left out, as it went (C always @; got False",
    "controller.solver=clarabell": "controller.solver: no solver named 'clarabell'; did you mean 'clarabel'?@",
    "controller.solver=piqp-multistage-1": "controller.solver: the solver 'piqp-multistage-1' was removed: use "
    "'piqp-multistage'",
    "controller.solver=core-or-piqp": "controller.solver: the solver 'core-or-piqp' was removed: use 'core'",
    "vehicle.file=lopes": "no vehicle named 'lopes'; did you mean 'lopes2011'?@",
    "vehicle.mass=40": "vehicle.speed_max must be no lower than its hover speed, 609.687 rad/s, or it cannot hover (@",
    "vehicle.inertia=[0.03, 0.03, 0.07]": "vehicle.inertia must be such that no moment exceeds the sum of the @",
    "actual.mas=4.4": "actual.mas is not a field of the scenario file; did you mean 'mass'?@",
    "effects.rotors={rise=1e-310, fall=1e-310}": "effects.rotors.rise must be a number >= 1e-06 and <= 1000000; got "
    "1e-310@effects.rotors.fall must be a number >= 1e-06 @",
    "events=[{type='rotor_lag', at=1, rise=1e-310}]": "events.0.rise must be 0, or at least 1e-06 s; got 1e-310",
    "autopilot={gyro_cutoff=1e-310}": "autopilot.gyro_cutoff must be 0, or at least 1e-06 Hz; got 1e-310",
    "effects.load.payloads=[{mass=1e-310}]": "effects.load.payloads.0.mass must be a number >= 1e-06 and @; got 1e-310",
    "vehicle.rotor_rise=1e-310": "vehicle.rotor_rise must be between 1e-06 and 1e+06 s; got 1e-310",
    "vehicle.inertia=[1e-310, 0.04, 0.05]": "vehicle.inertia must be between 1e-12 and 1e+06 kg m^2; got 1e-310",
    "control_period=0.0503": "control_period must be a whole multiple of the physics step plant.timestep = 0.001 s; "
    "got 0.0503",
    "log_rate=3": "log_rate must have a period that is a whole multiple of the physics step plant.timestep = 0.001 s; "
    "got 3.0",
    "constraints=[{name='a', signal='x', lower=1, upper=0}]": "constraints.a.lower must be below upper = 0.0; got 1.0",
    "constraints=[{name='a', signal='x'}, {name='a', signal='y'}]": "constraints must have distinct names@",
    "controller={type='unconstrained', horizon=1, output_weights={x=1, vx=1}, input_weights={speed=1}}": "controller."
    "horizon must be at least 2 where output_weights have vx, whose desired values are @",
    "controller.output_weights={q=1}": "controller.output_weights.q is not a state (there are: x, vx, @",
    "controller.polytopes=[{name='p', of=['x'], rows=[[1]], upper=[]}]": "controller.polytopes.p.upper must have one "
    "number per row, 1; got []",
    "controller={type='nonlinear', tilt=90}": "controller.tilt must be a number > 0 and < 90; got 90",
    "reference={radius=2, type='circle'}": "reference.period must be given, or speed, but not both; got {}",
    "reference={type='csv', file='gone.csv'}": "gone.csv: cannot be read (@",
    "reference={type='waypoints', points=[{position=[1, 2]}]}": "reference.points.0.position must be a list of 3 @",
    "effects.air.wind=[3, 0, 0]": DRAGLESS,
    "effects.load.mass_factor=0": "effects.load.mass_factor must be a number >= 0.05 and <= 20; got 0",
    "effects.rotors.inertia=1e-4": "effects.rotors.inertia must be 0 where rotors change their speed at once@",
    "events=[{type='payload_drop', at=1}]": "events.0.type must not be payload_drop at 1.0 s: nothing is carried",
    "events=[{type='stall', at=10, duration=1}]": "events.0.at must be before the flight's end, 10.0 s; got 10.0",
    "events=[{type='controller', at=1, fields={horizn=3}}]": "events.0.fields: controller.horizn is not a field of the "
    "scenario file; did you mean 'horizon'?@",
    "estimator.type=error_state": "estimator must have sensors.position to work with; got []",
    "sensors.position.rate=300": "sensors.position.rate must be a divisor of the physics rate of 1000 Hz; got 300.0",
    "initial.cold=true": "initial.cold must be false where effects.ground gives no floor to stand on; got true",
    "initial.rotor_speeds=[9, 9, 9, 251]": "initial.rotor_speeds must be at most 250 rad/s each, the speed_max of @",
    "obstacles=[{type='sphere', name='a', position=[0, 0, 1], radius=1}]": "initial.position must be clear of a, by @",
    "effects.load.centre_of_mass=[0.01,0,0] plant.integrator=rk4": "plant.integrator must be mujoco with effects.load."
    "centre_of_mass; got 'rk4'",
    "effects.load.payloads=[{mass=0.1}] plant.integrator=rk4": "plant.integrator must be mujoco with a payload; got "
    "'rk4'",
    "forces=[{type='a:b:c'}]": "forces.0.type must be of the form package.module:Class; got 'a:b:c'",
    "seed=0x1ffffffffffffffff": f"seed {SEED}; got a whole number of 65 bits",
    "seed=" + 5000 * "9": f"seed {SEED}; got '9999@",
    "seed=" + 99_999 * "[": NESTED,
    "duration=1\nseed=2": "duration must be a number >= 1e-06 and <= 86400; got '1\\nseed=2'",
    "duration=" + 300 * "x": "duration must be a number >= 1e-06 and <= 86400; got '" + 196 * "x" + "...",
    ".".join(40_000 * "a") + "=1": NESTED,
    "controller={" + ".".join(40_000 * "a") + "=1}": NESTED,
    "constraints=[" + ",".join(["{}"] * 1001) + "]": "constraints must be a list of 1000 or fewer entries; got [{}@",
    "events.2.at=3": "--set must be a path to a field; events has none; got 'events.2.at=3'",
    "base=hover": "--set must be of a field other than base, which only a file can have; got 'base=hover'",
}


@pytest.mark.parametrize(("setting", "expected"), MISTAKES.items(), ids=lambda text: text[:40])
def test_a_mistake_has_a_message_that_says_what_is_allowed(setting: str, expected: str) -> None:
    settings = re.split(r" (?=plant)", setting)  # two of them are pairs
    message = refusal(lambda: load_scenario("hover", settings))
    assert matches(message.removeprefix("hover.toml: "), expected)
    assert len(message) < 1000


FILES: dict[Callable[[Path, str], None], dict[str, str]] = {
    load_file: {
        "name = ": "is not valid TOML: @",
        'base = "x.toml"': "is its own base: x.toml -> x.toml",
        'base = "y.toml"': "gone.toml: no such scenario file",
        'base = "papr-constrained"': "no scenario named 'papr-constrained'; did you mean 'paper-constrained'?@",
        "": "name is missing@description is missing@",
    },
    load_course: {
        "": "row 1: must be a header, such as t,x,y,z,yaw; the file is empty",
        "t,x,y,z,yaw\n0,0,0,1,0\n1,0,0,1,0\n1,0,0,1,0\n": "row 4, column t: must be above that of the row @",
        "t,x,y,z,yaw\n0,0,0,1,0\n1,0,,1,0\n": "row 3, column y: is empty",
        "t,x,y,z,yaw\n0,0,0,1,0\n1,high,0,0,0\n": "row 3, column x: must be a number; got 'high'",
        "t,x,y,z,yaw\n0,0,0,0,nan\n1,0,0,0,0\n": "row 2, column yaw: must be a finite number within +-1e+06; got 'nan'",
        "t,x,y,z,yaw\n0,0,0,0,0\n1,0,0,0\n": "row 3: must have 5 cells (t,x,y,z,yaw); got 4",
        "t,x,y,z,yaw\n0,0,0,0,0\n": "must have 2 or more rows below its header; got 1",
        't,x,y,z,yaw\n0,0,0,1,0\n1,0,0,1,0\n2,"0,0,1,0\n': "cannot be read (@)",
    },
    load_edited: {
        'name = "lopes2011" => name = 3': "vehicle.name must be a text; got 3",
        'name = "lopes2011" => ': "lacks name",
        "[arm_length] => [rotor_lag]": "no vehicle parameter named 'rotor_lag'; did you mean 'rotor_rise' and "
        "'rotor_fall'?@",
        'unit = "kg" => unit = "g"': "vehicle.mass.unit must be 'kg'; got 'g'",
        "value = 4.0 => value = 40.0": "vehicle.speed_max must be no lower than its hover speed, 609.687 rad/s, or it@",
    },
    load_campaign: {
        "fligths = 4": "fligths is not a field of the campaign file; did you mean 'flights'?@",
        "failure = ['lots']": "failure has an entry 'lots' that is no event: @; did you mean 'lost'?@",
        "failure = ['rmse.q > 1']": "failure: no column named 'rmse.q'; did you mean 'rmse.z'?@",
        "failure = ['status > 0']": "failure: event 'status > 0' compares with a number; the column @ holds text",
        "set = {duration=-1.0}": "x.toml, hover: duration must be a number >= 1e-06 and <= 86400; got -1.0",
        vary("low=1.1, high=0.9"): "vary.mass.low must be below high; got 1.1 and 0.9",
        vary("low=0.01, high=1.1"): "vary.mass at 0.01: effects.load.mass_factor must be a number >= 0.05 and <= 20; "
        "got 0.01",
        vary("low=0.9, high=1.1, relative=true"): "vary.mass.relative must be false where the scenario has no number @",
        vary("low=0.9, high=1.1", "seed"): "vary.mass.fields must not have seed: every flight has one of its own",
        vary(
            "low=0.5, high=1.0", "duration"
        ): "none of the first 4 flights can be flown, the first since c-0: duration @",
    },
}
"""Of each kind of file, contents or edits, and the messages for them."""


@pytest.mark.parametrize("load", FILES)
def test_a_file_that_cannot_be_is_refused(load: Callable[[Path, str], None], tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    for text, expected in FILES[load].items():
        message = refusal(partial(load, path, text))
        without_file = message.removeprefix(f"{path}: ").removeprefix("x.toml: ")
        assert matches(without_file, expected), (text, message)


@pytest.mark.parametrize("content", [b"\xff\xfe\x00", "t,x,y,z,yaw\n".encode("utf-16")])
def test_a_file_that_is_no_text_is_refused(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    path.write_bytes(content)
    course = [f"reference={{type='csv', file='{path}'}}"]
    for load in (
        lambda: load_scenario(str(path)),
        lambda: load_plan(str(path)),
        lambda: load_vehicle(path),
        lambda: load_scenario("hover", course),
    ):
        assert matches(refusal(load), "@x.toml: cannot be read @")


@pytest.mark.parametrize(
    "line",
    [
        "run hovver",
        "run nowhere.toml",
        "check runs/none",
        "run hover --set controller.horizn=3",
        "run hover --set duration=abc",
        "run hover --set vehicle.file=lopes",
        "vehicle lopes",
        "runn hover",
        "run hover --fro",
        "video runs/none",
    ],
)
def test_a_usual_mistake_gives_one_message_and_no_traceback(line: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(line.split()) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.parametrize("command", ["run", "check", "scenario", "compare", "campaign"])
def test_every_command_reports_it_once_and_writes_nothing(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    file = 'base = "hover"\nseed = -1\n'
    refused = "seed"
    others = []
    if command == "campaign":
        file = CAMPAIGN.replace("flights = 4", "flights = 0")
        refused = "flights"
        others = ["--out", "out"]
    if command == "compare":
        others = ["hover", "--out", "page"]
    Path("mine.toml").write_text(file)
    assert main([command, "mine.toml", *others]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    (message,) = printed.err.splitlines()
    assert message.startswith(f"quadsim: mine.toml: {refused} must be ")
    assert [path.name for path in tmp_path.iterdir()] == ["mine.toml"]


@pytest.mark.parametrize(
    ("name", "limit", "most", "expected"),
    [
        ("x.toml", "quadsim.assets.LARGEST_TOML", 20, "must be of 20 or fewer bytes; got 30"),
        ("x.csv", "quadsim.scenarios.courses.csv_course.LARGEST_CSV", 30, "must be of 30 or fewer bytes; got 48"),
        ("x.toml", "quadsim.assets.MOST_ASSIGNMENTS", 1, "must assign at most 1 values; it has 2 equals signs"),
        (
            "x.csv",
            "quadsim.scenarios.courses.csv_course.MOST_COURSE_ROWS",
            1,
            "must have 1 or fewer rows below its header",
        ),
    ],
)
def test_a_file_that_is_too_large_is_refused(
    name: str, limit: str, most: int, expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / name
    if name == "x.toml":
        load = load_file
        text = 'base = "hover"\nname = "mine"\n\n'
    else:
        load = load_course
        text = "t,x,y,z,yaw\n" + "0.0,0.0,0.0,1.0,0\n" + "1.0,0.0,0.0,1.0,0\n"
    load(path, text)
    monkeypatch.setattr(limit, most)
    assert matches(refusal(lambda: load(path, text)), f"@{name}: {expected}")


def test_a_folder_that_is_not_utf_8_is_named(tmp_path: Path) -> None:
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9"))
    folder.mkdir()
    (folder / "own.py").write_text("def law(now, state, reference):\n    return [190.0] * 4\n")
    (folder / "own.toml").write_text('base = "hover"\nname = "own"\ncontroller = "own:law"\n')
    message = refusal(lambda: load_scenario(str(folder / "own.toml")))
    assert message.startswith("own.toml: controller.folder must be UTF-8, as every path and text; got '")
    assert message.endswith("/caf\\udce9'; rename it")


def test_all_problems_are_named_at_once_but_for_those_beyond_twenty() -> None:
    """One of the seed and 25 of windows that end before they start."""
    windows = "[" + ", ".join(["{start=1, stop=0, value=1}"] * 25) + "]"
    message = refusal(lambda: load_scenario("hover", [f"reference={{x={windows}}}", "seed=-1"]))
    *lines, last = message.splitlines()
    assert (len(lines), last) == (20, "  and 6 more")
    assert lines[0] == f"hover.toml: seed {SEED}; got -1"
    assert lines[-1] == "  reference.x.18.start must be below stop = 0.0; got 1.0"


@pytest.mark.parametrize(
    "setting",
    [
        "expect=lost",
        "effects.load.mass_factor=10",
        "effects.load.payloads=[{mass=100}]",
        "effects.rotors.efficiency=[0, 0, 0, 0]",
        "events=[{type='payload_pickup', at=1, mass=50}]",
        "events=[{type='rotor_loss', at=1, rotor=1, loss=1}]",
        "computation.delay=100",
        "initial.position=[0, 0, -5]",
        "sensors.position={rate=0.01, dropout=1}",
    ],
)
def test_a_plant_that_its_controller_cannot_fly_is_no_wrong_input(setting: str) -> None:
    assert refusal(lambda: load_scenario("hover", [setting])) == "accepted"


def test_a_text_with_many_dots_is_not_taken_for_nested_tables() -> None:
    text = " ".join(["a.b.c,"] * 100)
    assert load_scenario("hover", [f"description={text}"]).description == text
