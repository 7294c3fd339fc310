"""What cannot be flown is refused by a message that names the field or the row, before anything is flown or written."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import pytest
from support import scenario_table

from quadsim.assets import vehicle_path
from quadsim.errors import InputError
from scenarios.cli import main
from scenarios.courses import csv_course
from scenarios.loading import load_scenario, parse_scenario
from scenarios.schema import bases
from scenarios.schema.base import MOST_ENTRIES
from scenarios.schema.events import MOST_EVENTS
from scenarios.schema.problems import ScenarioError

MINE = 'base = "hover"\nname = "mine"\n'
ESTIMATOR = ["estimator.type=error_state", "sensors.attitude={rate=100, noise=1}"]
COLD = ["initial.cold=true", "effects.ground.contact=true"]
STALLS = "events=[" + ", ".join(["{type='stall', at=1, duration=0.1}"] * (MOST_EVENTS + 1)) + "]"


def event(kind: str, rest: str = "") -> str:
    return f"events=[{{type='{kind}', at=1{rest and ', '}{rest}}}]"


# Given by --set on hover: the message; @ matches anything.
WRONG: list[tuple[str, str | list[str], str]] = [
    # rotors
    ("no lag", "effects.rotors.rise=0", "effects.rotors.rise must be > 0.0; got 0"),
    ("negative lag", "effects.rotors.fall=-0.1", "effects.rotors.fall must be > 0.0; got -0.1"),
    ("infinite lag", "effects.rotors.rise=inf", "effects.rotors.rise must be a finite number; got inf"),
    ("no acceleration", "effects.rotors.acceleration=0", "effects.rotors.acceleration must be > 0.0; got 0"),
    (
        "inertia without lag",
        "effects.rotors.inertia=1e-4",
        "effects.rotors.inertia must be 0 where rotors change their speed at once: that would take an infinite torque; "
        "got 0.0001",
    ),
    (
        "efficiency",
        "effects.rotors.efficiency=[1, 1, 1, 2]",
        "effects.rotors.efficiency.3 must be <= 1.0; got 2",
    ),
    ("three rotors", "effects.rotors.efficiency=[1, 1, 1]", "effects.rotors.efficiency must be a list of 4 numbers;@"),
    (
        "unknown effect",
        "effects.rotrs.rise=1",
        "effects.rotrs is not a field of the scenario file; did you mean 'rotors'?@",
    ),
    (
        "misspelt",
        "effects.rotors.ris=1",
        "effects.rotors.ris is not a field of the scenario file; did you mean 'rise'?@",
    ),
    ("effects", "effects=3", "effects must be a table; got 3"),
    # air
    ("wind nan", "effects.air.wind=[nan, 0, 0]", "effects.air.wind.0 must be a finite number; got nan"),
    (
        "wind without drag",
        "effects.air.wind=[3, 0, 0]",
        "effects.air.rotor_drag must be positive, or body_drag given, for the wind to push: the vehicle 'lopes2011' "
        "states no drag; got 0.0",
    ),
    ("gust without drag", event("gust", "duration=1, velocity=[1, 0, 0]"), "effects.air.rotor_drag must be positive,@"),
    ("change of wind without drag", event("wind", "velocity=[1, 0, 0]"), "effects.air.rotor_drag must be positive,@"),
    (
        "turbulence without drag",
        "effects.air.turbulence={wind_speed_20ft=5, airspeed=3}",
        "effects.air.rotor_drag must be positive,@",
    ),
    (
        "turbulence without wind",
        "effects.air.turbulence.wind_speed_20ft=5",
        "effects.air.turbulence.airspeed must be given where no mean wind of 0.01 to 200 m/s carries the turbulence "
        "past; got a wind of [0.0, 0.0, 0.0]",
    ),
    (
        "turbulence with next to no wind",
        "effects.air={wind=[1e-100, 0, 0], turbulence={wind_speed_20ft=5}}",
        "effects.air.turbulence.airspeed must be given where@; got a wind of [1e-100, 0.0, 0.0]",
    ),
    (
        "turbulence with too much wind",
        "effects.air={wind=[0, 0, 300], turbulence={wind_speed_20ft=5}}",
        "effects.air.turbulence.airspeed must be given where@; got a wind of [0.0, 0.0, 300.0]",
    ),
    (
        "turbulence that stands",
        "effects.air.turbulence={wind_speed_20ft=5, airspeed=0.001}",
        "effects.air.turbulence.airspeed must be >= 0.01; got 0.001",
    ),
    (
        "turbulence too low",
        "effects.air.turbulence={wind_speed_20ft=5, altitude=1}",
        "effects.air.turbulence.altitude must be >= 3.048; got 1",
    ),
    ("body drag", "effects.air.body_drag=[1, 1, 0]", "effects.air.body_drag.2 must be > 0.0; got 0"),
    ("density", "effects.air.density=0", "effects.air.density must be > 0.0; got 0"),
    # ground
    (
        "below the floor",
        ["effects.ground.contact=true", "initial.position=[0, 0, -0.5]"],
        "initial.position must be 0.5 m higher, at roll 0 and pitch 0 deg, for feet and hull to clear the floor; "
        "got [0.0, 0.0, -0.5]",
    ),
    (
        "on its side in the floor",
        ["effects.ground.effect=true", "initial.position=[0, 0, 0]", "initial.euler=[89, 0, 0]"],
        "initial.position must be 0.@",
    ),
    (
        "cold in the air",
        [*COLD, "initial.position=[0, 0, 1]"],
        "initial.position must be on the floor where initial.cold is true, or it would fall: its feet are 1 m above it"
        "; got [0.0, 0.0, 1.0]",
    ),
    (
        "cold without floor",
        "initial.cold=true",
        "initial.cold must be false where effects.ground gives no floor to stand on; got true",
    ),
    ("radius", "effects.ground={effect=true, rotor_radius=0}", "effects.ground.rotor_radius must be > 0.0; got 0"),
    (
        "side",
        "initial.euler=[0, 100, 0]",
        "initial.euler must have a roll within +-180 deg and a pitch within +-90 deg;@",
    ),
    # load
    ("payload", "effects.load.payloads=[{mass=-1}]", "effects.load.payloads.0.mass must be > 0.0; got -1"),
    ("mass factor", "effects.load.mass_factor=0", "effects.load.mass_factor must be >= 0.05; got 0"),
    (
        "no rigid body",
        "effects.load.inertia_factor=[1, 1, 20]",
        "effects.load.inertia_factor must be such that no moment of [0.033, 0.033, 1.32] kg m^2 exceeds the sum of the "
        "other two; got [1.0, 1.0, 20.0]",
    ),
    ("noise", "effects.disturbance.force_noise=-1", "effects.disturbance.force_noise must be >= 0.0; got -1"),
    # events
    (
        "late",
        event("payload_pickup", "mass=1").replace("at=1", "at=10"),
        "events.0.at must be before the flight's end, 10.0 s;@",
    ),
    ("early", event("stall", "duration=1").replace("at=1", "at=-1"), "events.0.at must be >= 0.0; got -1"),
    ("when", event("stall", "duration=1").replace("at=1", "at=nan"), "events.0.at must be a finite number; got nan"),
    ("nothing to drop", event("payload_drop"), "events.0.type must not be payload_drop at 1.0 s: nothing is carried"),
    ("fifth rotor", event("rotor_loss", "rotor=5, loss=1"), "events.0.rotor must be <= 4; got 5"),
    ("no loss", event("rotor_loss", "rotor=1, loss=0"), "events.0.loss must be > 0.0; got 0"),
    ("unknown event", event("gst"), "events.0 must be one of@ in its field type; got 'gst'; did you mean 'gust'?"),
    ("no type", "events=[{at=1}]", "events.0 must be a table with a field type; got None"),
    ("no list", "events={at=1}", "events must be a list; got {'at': 1}"),
    ("into no list", "events.0.at=1", "events must be a list; got {'0': {'at': 1}}"),
    (
        "unknown sensor",
        event("sensor_fault", "sensor='gps', fault='nan', duration=1"),
        "events.0.sensor must be one of@",
    ),
    (
        "bias of nothing",
        event("sensor_fault", "sensor='rates', fault='bias', duration=1"),
        "events.0.offset must be given where fault is 'bias', and nowhere else; got None",
    ),
    (
        "axes without nan",
        event("sensor_fault", "sensor='rates', fault='freeze', duration=1, axes=['x']"),
        "events.0.axes must be absent where fault is not 'nan'; got ['x']",
    ),
    (
        "one axis twice",
        event("sensor_fault", "sensor='rates', fault='nan', duration=1, axes=['x', 'x']"),
        "events.0.axes must be different ones; got ['x', 'x']",
    ),
    (
        "fault of no sensor",
        [
            *ESTIMATOR,
            "sensors.position={rate=10, noise=1}",
            event("sensor_fault", "sensor='rates', fault='nan', duration=1"),
        ],
        "events.0.sensor must be one that the estimator has, of position, attitude; got 'rates'",
    ),
    ("too many", STALLS, "events must be of 20000 or fewer entries; got 20001"),
    ("push nowhere", event("push", "duration=1"), "events.0.force is missing"),
    ("push for no time", event("push", "duration=0, force=[1, 0, 0]"), "events.0.duration must be > 0.0; got 0"),
    ("no set-point", event("setpoint"), "events.0.x must be given, or y, z or yaw"),
    ("no mass", event("mass", "factor=0"), "events.0.factor must be >= 0.05; got 0"),
    ("lag backwards", event("rotor_lag", "rise=-0.1"), "events.0.rise must be >= 0.0; got -0.1"),
    (
        "inertia at once",
        ["effects.rotors={rise=0.05, fall=0.05, inertia=1e-5}", event("rotor_lag", "rise=0")],
        "effects.rotors.inertia must be 0 where rotors change their speed at once@",
    ),
    ("no fields", event("controller", "fields={}"), "events.0.fields must be@"),
    (
        "no such field",
        event("controller", "fields={horizn=3}"),
        "events.0.fields: controller.horizn is not a field of the scenario file; did you mean 'horizon'?@",
    ),
    (
        "no such weight",
        event("controller", "fields={'output_weights.z'=-1.0}"),
        "events.0.fields: controller.output_weights.z must be > 0.0; got -1.0",
    ),
    (
        "a law with parts missing",
        event("controller", "fields={type='constrained'}"),
        "events.0.fields: controller.horizon is missing;@",
    ),
    (
        "through a number",
        event("controller", "fields={'horizon.of'=1}"),
        "events.0.fields: fields must be a path to a field; horizon has none; got 'horizon.of'",
    ),
    (
        "mass that rk4 does not know",
        ["plant.integrator=rk4", event("mass", "factor=1.1")],
        "plant.integrator must be mujoco where there is a load; got 'rk4'",
    ),
    # sensors, estimator, computation
    ("gps", "sensors.gps.rate=10", "sensors.gps is not a field of the scenario file (there are: position,@"),
    (
        "no divisor",
        "sensors.position.rate=300",
        "sensors.position.rate must be a divisor of the physics rate of 1000 Hz; got 300.0",
    ),
    ("1 MHz", "sensors.position.rate=1e6", "sensors.position.rate must be <= 10000.0; got 1000000.0"),
    (
        "no whole step",
        "sensors.position={rate=100, delay=0.0005}",
        "sensors.position.delay must be a whole multiple of the physics step of 0.001 s; got 0.0005",
    ),
    ("endless delay", "sensors.rates={rate=100, delay=11}", "sensors.rates.delay must be <= 10.0; got 11"),
    ("dropout", "sensors.rates={rate=100, dropout=2}", "sensors.rates.dropout must be <= 1.0; got 2"),
    ("noise nan", "sensors.rates={rate=100, noise=nan}", "sensors.rates.noise must be a finite number; got nan"),
    (
        "two axes",
        "sensors.rates={rate=100, noise=[1, 2]}",
        "sensors.rates.noise must be a list of 3 numbers; got [1, 2]",
    ),
    ("no sensors", "estimator.type=error_state", "estimator must have sensors.position to work with; got []"),
    ("no position", ESTIMATOR, "estimator must have sensors.position to work with; got ['attitude']"),
    (
        "no noise",
        [*ESTIMATOR, "sensors.position.rate=100"],
        "sensors.position.noise must be positive, for the estimator to weigh its samples; got 0.0",
    ),
    ("computation", "computation.delay=-1", "computation.delay must be >= 0.0; got -1"),
    # times and seeds
    ("seed", "seed=-1", "seed must be >= 0; got -1"),
    ("long seed", "seed=0x1ffffffffffffffff", "seed must be <= 9223372036854775807; got a whole number of 65 bits"),
    ("endless seed", "seed=" + 5000 * "9", "seed must be a whole number; got '9999@"),
    ("period", "control_period=0.0503", "control_period must be a whole multiple of the physics step plant.timestep@"),
    ("a date", "duration=2024-01-31", "duration must be a number; got 2024-01-31"),
    ("a time", "duration=07:32:00", "duration must be a number; got 07:32:00"),
    ("a long text", "duration=" + 300 * "x", "duration must be a number; got '" + 196 * "x" + "..."),
    ("two lines", "duration=1\nseed=2", "duration must be a number; got '1\\nseed=2'"),
    ("a deep list", "duration=" + 6 * "[" + 6 * "]", "duration must be a number; got [[[[...]]]]"),
    (
        "endless lists",
        "duration=" + 2000 * "[" + 2000 * "]",
        "--set must be of at most 20 tables and lists within one another@",
    ),
    (
        "too deep a list",
        "duration=" + 30 * "[" + 30 * "]",
        "--set must be of at most 20 tables and lists within one another; got 'duration=[[[@",
    ),
    ("too deep a path", "a" + 20 * ".a" + "=1", "--set must be of at most 20 tables and lists within one another;@"),
    (
        "a long list",
        "seed=[1, 2, 3, 4, 5, 6, 7, 8, 9, 0, 1]",
        "seed must be a whole number; got [1, 2, 3, 4, 5, 6, 7, 8, 9, 0, ...]",
    ),
    ("a table", "seed={a = 1}", "seed must be a whole number; got {'a': 1}"),
    ("a base", "base=hover", "--set must be of a field other than base, which only a file can have; got 'base=hover'"),
    # vehicle
    (
        "too heavy to hover",
        "vehicle.mass=40",
        "vehicle.speed_max must be no lower than its hover speed, 609.687 rad/s, or it cannot hover (rotors hold 0 to "
        "250 rad/s; 40 kg weigh 392.4 N, the rotors lift 65.98 N at 250 rad/s); got 250.0",
    ),
    ("no mass", "vehicle.mass=0", "vehicle.mass must be positive; got 0.0"),
    ("no vehicle", "vehicle.file=lopes", "no vehicle named 'lopes'; did you mean 'lopes2011'?@"),
    ("no vehicle file", "vehicle.file=gone.toml", "gone.toml: no such vehicle file"),
    # courses
    ("no course file", "reference={type='csv', file='gone.csv'}", "gone.csv: cannot be read@"),
    ("no file name", 'reference={type="csv", file="a\\u0000b"}', r"a\x00b: cannot be read (@embedded null @)"),
    ("a device", "reference={type='csv', file='/dev/null'}", "/dev/null: cannot be read (it is not a file)"),
    (
        "no way to go",
        "reference={type='minimum_snap', points=[{position=[0, 0, 1]}], speed=1}",
        "reference.points.0.position must be 0.001 m or more from the initial position,@",
    ),
    (
        "misspelt point",
        "reference={type='waypoints', points=[{position=[0, 0, 2], yw=1}]}",
        "reference.points.0.yw is not a field of the scenario file; did you mean 'yaw'?@",
    ),
]


@pytest.mark.parametrize(("given", "message"), [entry[1:] for entry in WRONG], ids=[entry[0] for entry in WRONG])
def test_what_cannot_be_flown_is_refused_when_it_is_read(given: str | list[str], message: str) -> None:
    with pytest.raises(InputError) as caught:
        load_scenario("hover", [given] if isinstance(given, str) else given)
    assert_message(str(caught.value).removeprefix("hover.toml: "), message)
    assert caught.value.exit_status == 2


def assert_message(error: str, message: str) -> None:
    """Compare an error with a message in which @ matches anything on its line."""
    assert re.fullmatch(".*".join(map(re.escape, message.split("@"))), error), error


# --- files ---------------------------------------------------------------------------------------------------------

FILES: list[tuple[str, str, str]] = [
    ("no TOML", "name = ", "@x.toml: is not valid TOML: @"),
    ("nested without end", f"a = {5000 * '['}", "@x.toml: must have at most 20 tables and lists within one another"),
    ("a number without end", MINE + f"seed = {5000 * '9'}", "@x.toml: is not valid TOML: @5000 digits@"),
    ("deep tables", MINE + f"a{20 * '.a'} = 1", "@x.toml: must have at most 20 tables and lists within one another"),
    ("its own base", 'base = "x.toml"', "@x.toml: is its own base: x.toml -> x.toml"),
    ("no such base", 'base = "hovr"', "no scenario named 'hovr'; did you mean 'hover'? @"),
    ("no such base of a base", 'base = "y.toml"', "gone.toml: no such scenario file"),
    ("a base that is no text", "base = 3", "x.toml.base must be a scenario's name or a path ending in .toml; got 3"),
    (
        "two of one name",
        MINE + "constraints = [{name='a', signal='x', upper=1}, {name='a', signal='y', upper=1}]",
        "x.toml: constraints must have distinct names; got ['a', 'a']",
    ),
    (
        "a name that is no text",
        MINE + "constraints = [{name=[3], signal='x'}]",
        "x.toml: constraints.0.name must be a text; got [3]",
    ),
    (
        "misspelt in an entry",
        MINE + "constraints = [{name='roll', uper=3}]",
        "x.toml: constraints.roll.uper is not a field of the scenario file; did you mean 'upper'? @",
    ),
    (
        "a file name without end",
        MINE + f"vehicle.file = '{300 * 'a'}.toml'",
        "@aaa: cannot be read (File name too long)",
    ),
]


@pytest.mark.parametrize(("text", "message"), [entry[1:] for entry in FILES], ids=[entry[0] for entry in FILES])
def test_a_file_that_cannot_be_flown_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "y.toml").write_text('base = "gone.toml"')
    path = tmp_path / "x.toml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        load_scenario(str(path))
    assert_message(str(caught.value), message)


def test_a_misspelt_base_is_guessed(tmp_path: Path) -> None:
    (tmp_path / "x.toml").write_text('bas = "hover"')
    with pytest.raises(ScenarioError) as caught:
        load_scenario(str(tmp_path / "x.toml"))
    assert_message(caught.value.problems[0], "bas is not a field of the scenario file; did you mean 'base'? @")


def test_a_file_that_is_too_large_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bases, "LARGEST_FILE", 20)
    (tmp_path / "x.toml").write_text(MINE)
    with pytest.raises(InputError, match=rf"x\.toml: must be of 20 or fewer bytes; got {len(MINE)}$"):
        load_scenario(str(tmp_path / "x.toml"))


def test_the_longest_lists_fit_into_a_file() -> None:
    entry = '[[events]]\ntype = "sensor_fault"\nat = 1.0\nsensor = "position"\nfault = "bias"\nduration = 1.0\n'
    lines = 2 * len(entry) * MOST_ENTRIES  # comments as long as the entries themselves
    assert 4 * lines + 2 * len(entry) * MOST_EVENTS < bases.LARGEST_FILE


def test_many_problems_are_counted_not_listed() -> None:
    windows = [{"start": 1.0, "stop": 0.0, "value": 1.0}] * 25
    with pytest.raises(ScenarioError) as caught:
        parse_scenario(scenario_table() | {"reference": {"x": windows}})
    lines = str(caught.value).splitlines()
    assert len(caught.value.problems) == 25
    assert len(lines) == 21
    assert lines[19:] == ["  reference.x.19.start must be below stop = 0.0; got 1.0", "  and 5 more"]


# --- courses from a file -------------------------------------------------------------------------------------------

HEADER = "t,x,y,z,yaw\n"
ROWS = HEADER + "0,0,0,1,0\n1,0,0,1,0\n"
TABLES: list[tuple[str, bytes | str, str]] = [
    ("empty", "", "row 1: the header must be t,x,y,z,yaw or t,x,y,z,yaw,vx,vy,vz; got none"),
    ("wrong header", "t,x,y,z\n", "row 1: the header must be @; got 4 columns, t,x,y,z of them"),
    ("long header", 100 * "t" + "\n", "row 1: the header must be @; got 1 columns, none of them"),
    ("other separator", ROWS.replace(",", ";"), "row 1: the header must be @; got 1 columns, none of them"),
    ("no rows", HEADER, "must have 2 or more rows below its header; got 0"),
    ("blank row", ROWS + "\n2,0,0,1,0\n", "row 4: must have 5 cells (t,x,y,z,yaw); got 0"),
    ("row of nothing", ROWS + ",,,,\n", "row 4, column t: is empty"),
    ("gap", ROWS + "2,,0,1,0\n", "row 4, column x: is empty"),
    ("cells missing", ROWS + "2,0,0\n", "row 4: must have 5 cells (t,x,y,z,yaw); got 3"),
    ("unsorted", ROWS + "0.5,0,0,1,0\n", "row 4, column t: must be above that of the row before = 1; got 0.5"),
    ("twice", ROWS + "1,0,0,1,0\n", "row 4, column t: must be above that of the row before = 1; got 1"),
    ("before 0", HEADER + "-1,0,0,1,0\n1,0,0,1,0\n", "row 2, column t: must be >= 0; got -1"),
    ("text", ROWS + "2,0,abc,1,0\n", "row 4, column y: must be a number; got 'abc'"),
    ("underscore", ROWS + "2,0,1_0,1,0\n", "row 4, column y: must be a number; got '1_0'"),
    ("long text", ROWS + f"2,0,{100 * 'x'},1,0\n", "row 4, column y: must be a number; got 'xxx@xxx...'"),
    ("nan", ROWS + "2,nan,0,1,0\n", "row 4, column x: must be a finite number within +-1e+06; got 'nan'"),
    ("too large", ROWS + "2,0,0,1e7,0\n", "row 4, column z: must be a finite number within +-1e+06; got '1e7'"),
    ("other code", ROWS.encode("utf-16"), "cannot be read (@)"),
    ("open quote", ROWS + '2,"0,0,1,0\n', "cannot be read (@)"),
]


@pytest.mark.parametrize(("content", "message"), [entry[1:] for entry in TABLES], ids=[entry[0] for entry in TABLES])
def test_a_course_that_cannot_be_read_is_refused_by_row_and_column(
    tmp_path: Path, content: bytes | str, message: str
) -> None:
    path = tmp_path / "course.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError) as caught:
        load_scenario("hover", [f"reference={{type='csv', file='{path}'}}"])
    assert_message(str(caught.value), f"{path}: {message}")


@pytest.mark.parametrize("content", [b"\xef\xbb\xbf" + ROWS.encode(), ROWS.replace("\n", "\r\n").encode()])
def test_a_byte_order_mark_and_other_line_ends_are_no_mistakes(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "course.csv").write_bytes(content)
    load_scenario("hover", [f"reference={{type='csv', file='{tmp_path / 'course.csv'}'}}"])


def test_another_content_than_the_recorded_one_is_refused(tmp_path: Path) -> None:
    (tmp_path / "course.csv").write_text(ROWS)
    with pytest.raises(InputError, match=r"course\.csv: is not the file of the scenario: its SHA-256 is not 0+$"):
        load_scenario("hover", [f"reference={{type='csv', file='{tmp_path / 'course.csv'}', sha256='{64 * '0'}'}}"])


@pytest.mark.parametrize(
    ("name", "most", "message"),
    [
        ("LARGEST_FILE", 30, rf"course\.csv: must be of 30 or fewer bytes; got {len(ROWS)}$"),
        ("MOST_ROWS", 1, r"course\.csv: must have 1 or fewer rows below its header$"),
    ],
)
def test_a_course_that_is_too_long_is_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, most: int, message: str
) -> None:
    (tmp_path / "course.csv").write_text(ROWS)
    monkeypatch.setattr(csv_course, name, most)
    with pytest.raises(InputError, match=message):
        load_scenario("hover", [f"reference={{type='csv', file='{tmp_path / 'course.csv'}'}}"])


# --- the command line ----------------------------------------------------------------------------------------------

IMPOSSIBLE = {
    "effects.rotors.rise = 0": "mine.toml: effects.rotors.rise must be > 0.0; got 0",
    "effects.rotors.inertia = 1e-4": "effects.rotors.inertia must be 0 where rotors change their speed at once@",
    "effects.air.wind = [3, 0, 0]": "effects.air.rotor_drag must be positive, or body_drag given@",
    "vehicle.mass = 40": "vehicle.speed_max must be no lower than its hover speed@40 kg@",
}


@pytest.mark.parametrize(("line", "message"), IMPOSSIBLE.items(), ids=IMPOSSIBLE)
@pytest.mark.parametrize("command", ["run", "check", "scenario", "compare"])
def test_every_command_reports_it_once_and_writes_nothing(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    command: str,
    line: str,
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.toml").write_text(f"{MINE}{line}\n")
    arguments: Sequence[str] = [command, "mine.toml"]
    if command == "compare":  # reported before the valid one is flown
        arguments = [command, "hover", "mine.toml", "--out", "page"]
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert_message(err.removesuffix("\n"), f"quadsim: {message}")
    assert [path.name for path in tmp_path.iterdir()] == ["mine.toml"]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("value = 4.0", "value = 40.0", "vehicle.speed_max must be no lower than its hover speed, 609.687 rad/s, @"),
        ("value = 4.0", "value = nan", "vehicle.mass must be a finite number; got nan"),
        ('unit = "kg"', 'unit = "g"', "vehicle.mass.unit must be 'kg'; got 'g'"),
        ("[mass]", "[mas]", "no vehicle parameter named 'mas'; did you mean 'mass'? @"),
    ],
)
def test_a_vehicle_that_cannot_fly_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, message: str
) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(vehicle_path("lopes2011").read_text().replace(old, new, 1))
    assert main(["vehicle", str(path)]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert_message(err.removesuffix("\n"), f"quadsim: {message}")


# --- what is allowed, however unwise -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "setting",
    [
        "expect=lost",
        "effects.load.mass_factor=10",
        "effects.load.payloads=[{mass=100}]",
        "effects.rotors.efficiency=[0, 0, 0, 0]",
        event("payload_pickup", "mass=50"),
        event("rotor_loss", "rotor=1, loss=1"),
        "computation.delay=100",
        "initial.position=[0, 0, -5]",
        "sensors.position={rate=0.01, dropout=1}",
    ],
)
def test_a_plant_that_its_controller_cannot_fly_is_no_wrong_input(setting: str) -> None:
    load_scenario("hover", [setting])
