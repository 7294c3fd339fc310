"""Wrong input is refused at the front door by one message that names the field: the table is refusals.toml."""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from quadsim.assets import vehicle_path
from quadsim.errors import InputError
from quadsim.vehicle import load_vehicle
from scenarios.campaign.plan import load_plan
from scenarios.cli import main
from scenarios.loading import load_scenario, parse_scenario
from scenarios.schema.json_schema import scenario_schema

TABLE = tomllib.loads((Path(__file__).parent / "refusals.toml").read_text(encoding="utf-8"))
SEED = "must be a whole number >= 0 and <= 9223372036854775807"
NESTED = "--set must be of at most 20 tables and lists within one another@"
LONG = [  # settings too long for the table
    (
        "constraints=[" + ",".join(["{}"] * 1001) + "]",
        "constraints must be a list of 1000 or fewer entries; got [{}, {}@",
    ),
    ("seed=" + 5000 * "9", f"seed {SEED}; got '9999@"),
    ("duration=" + 300 * "x", "duration must be a number > 0 and <= 86400; got '" + 196 * "x" + "..."),
    ("duration=" + 2000 * "[" + 2000 * "]", NESTED),
    ("seed=" + 99_999 * "[", NESTED),
    (".".join(40_000 * "a") + "=1", NESTED),
    ("controller={" + ".".join(40_000 * "a") + "=1}", NESTED),
]
CAMPAIGN = """
name = "c"
scenario = "hover"
flights = 3
vary = [{name = "mass", fields = ["effects.load.mass_factor"], distribution = "uniform", low = 0.9, high = 1.1}]
"""


def refusal(load: Callable[[], object]) -> str:
    """The message by which something is refused, or that it is not."""
    try:
        load()
    except InputError as error:
        return str(error) if error.exit_status == 2 else f"exit status {error.exit_status}"
    return "accepted"


def matches(message: str, expected: str) -> bool:
    """Whether a message is the expected one, in which @ stands for anything."""
    return re.fullmatch(".*".join(map(re.escape, expected.split("@"))), message, re.DOTALL) is not None


def refused_settings(table: dict[str, Any]) -> Iterator[tuple[list[str], str]]:
    """The settings of one entry of the table, and the messages for them."""
    given = table.get("given", [])
    for field, pairs in table.get("must_be", {}).items():
        for value, rule in pairs:
            yield [*given, f"{field}={value}"], f"{field} must be {rule}; got @"
    for *settings, message in table.get("refused", []):
        yield settings, message


ENTRIES = [*TABLE["fields"], *TABLE["settings"]]


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda entry: f"{entry['scenario']} {entry.get('given', [''])[0][:40]}")
def test_a_setting_that_cannot_be_is_refused(entry: dict[str, Any]) -> None:
    name, wrong = entry["scenario"], []
    for settings, expected in refused_settings(entry):
        message = refusal(lambda settings=settings: load_scenario(name, settings))  # type: ignore[misc]
        if not matches(message.removeprefix(f"{name}.toml: "), expected):
            wrong.append((settings, message, expected))
    assert not wrong


@pytest.mark.parametrize(("setting", "expected"), LONG, ids=lambda text: text[:20])
def test_a_long_setting_is_refused_in_a_short_message(setting: str, expected: str) -> None:
    message = refusal(lambda: load_scenario("hover", [setting]))
    assert matches(message.removeprefix("hover.toml: "), expected)
    assert len(message) < 1000


def test_the_table_has_every_field_of_a_scenario() -> None:
    schema = scenario_schema()
    declared = {name for table in (schema, *schema["$defs"].values()) for name in table.get("properties", {})}
    text = " ".join(" ".join(settings) for entry in ENTRIES for settings, _ in refused_settings(entry))
    text += " ".join(TABLE["scenario_files"])
    missing = declared - set(re.findall(r"\w+", text))
    assert not missing, missing


@pytest.mark.parametrize("field", ["name", "duration", "control_period", "vehicle.file", "controller.horizon"])
def test_a_field_that_is_missing_is_named(field: str) -> None:
    data = tomllib.loads(load_scenario("hover").to_toml())
    table, _, name = field.rpartition(".")
    del (data[table] if table else data)[name]
    assert f"{field} is missing" in refusal(lambda: parse_scenario(data))


def load_course(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")
    load_scenario("hover", [f"reference={{type='csv', file='{path}'}}"])


def load_file(path: Path, text: str) -> None:
    path.with_name("y.toml").write_text('base = "gone.toml"')
    path.write_text(text, encoding="utf-8")
    load_scenario(str(path))


def load_edited(path: Path, edit: str) -> None:
    old, _, new = edit.partition(" => ")
    text = vehicle_path("lopes2011").read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    load_vehicle(path)


def load_campaign(path: Path, changes: str) -> None:
    """With fields of the changes instead of those of `CAMPAIGN`; `-field` leaves it out."""
    names = {line.split(" = ")[0].lstrip("-") for line in changes.splitlines()}
    kept = [line for line in CAMPAIGN.splitlines() if line.split(" = ")[0] not in names]
    path.write_text("\n".join(kept + [line for line in changes.splitlines() if not line.startswith("-")]))
    load_plan(str(path))


LOADERS = {"courses": load_course, "scenario_files": load_file, "vehicles": load_edited, "campaigns": load_campaign}


@pytest.mark.parametrize("kind", LOADERS)
def test_a_file_that_cannot_be_is_refused(kind: str, tmp_path: Path) -> None:
    path, wrong = tmp_path / "x.toml", []
    for text, expected in TABLE[kind].items():
        message = refusal(lambda text=text: LOADERS[kind](path, text))  # type: ignore[misc]
        if not matches(message.removeprefix(f"{path}: ").removeprefix("x.toml: "), expected):
            wrong.append((text, message, expected))
    assert not wrong


@pytest.mark.parametrize("content", [b"\xff\xfe\x00", "t,x,y,z,yaw\n".encode("utf-16")])
def test_a_file_that_is_no_text_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "x.toml").write_bytes(content)
    course = [f"reference={{type='csv', file='{tmp_path / 'x.toml'}'}}"]
    path = tmp_path / "x.toml"
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
def test_a_usual_mistake_takes_three_lines_at_most(line: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Of 120 characters, as a terminal breaks them."""
    assert main(line.split()) == 2
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1
    assert len(printed) <= 3 * 120


@pytest.mark.parametrize("command", ["run", "check", "scenario", "compare", "campaign"])
def test_every_command_reports_it_once_and_writes_nothing(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    file = CAMPAIGN.replace("flights = 3", "flights = 0") if command == "campaign" else 'base = "hover"\nseed = -1\n'
    Path("mine.toml").write_text(file)
    more = {"compare": ["hover", "--out", "page"], "campaign": ["--out", "out"]}.get(command, [])
    assert main([command, "mine.toml", *more]) == 2
    printed = capsys.readouterr()
    field = (
        "flights must be a whole number >= 1 and <= 1000000; got 0" if command == "campaign" else f"seed {SEED}; got -1"
    )
    assert (printed.out, printed.err) == ("", f"quadsim: mine.toml: {field}\n")
    assert [path.name for path in tmp_path.iterdir()] == ["mine.toml"]


@pytest.mark.parametrize(
    ("limit", "most", "expected"),
    [
        ("quadsim.assets.LARGEST_TOML", 20, "@x.toml: must be of 20 or fewer bytes; got 30"),
        ("scenarios.courses.csv_course.LARGEST_CSV", 30, "@x.csv: must be of 30 or fewer bytes; got 48"),
        ("quadsim.assets.MOST_ASSIGNMENTS", 1, "@x.toml: must assign at most 1 values; it has 2 equals signs"),
        ("scenarios.courses.csv_course.MOST_ROWS", 1, "@x.csv: must have 1 or fewer rows below its header"),
    ],
)
def test_a_file_that_is_too_large_is_not_read(
    limit: str, most: int, expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / expected[1:].partition(":")[0]
    if path.suffix == ".toml":
        load, text = load_file, 'base = "hover"\nname = "mine"\n\n'
    else:
        load, text = load_course, "t,x,y,z,yaw\n" + "0.0,0.0,0.0,1.0,0\n" + "1.0,0.0,0.0,1.0,0\n"
    load(path, text)
    monkeypatch.setattr(limit, most)
    assert matches(refusal(lambda: load(path, text)), expected)


def test_a_folder_that_is_not_utf_8_is_named(tmp_path: Path) -> None:
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9"))
    folder.mkdir()
    (folder / "own.py").write_text("def law(now, state, reference):\n    return [190.0] * 4\n")
    (folder / "own.toml").write_text('base = "hover"\nname = "own"\ncontroller = "own:law"\n')
    message = refusal(lambda: load_scenario(str(folder / "own.toml")))
    assert message.startswith("own.toml: controller.folder must be UTF-8, as every path and text; got '")
    assert message.endswith("/caf\\udce9'; rename it")


def test_all_problems_are_named_at_once_but_for_those_beyond_twenty() -> None:
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
        "description=" + "a.b.c, " * 100,
    ],
)
def test_a_plant_that_its_controller_cannot_fly_is_no_wrong_input(setting: str) -> None:
    assert load_scenario("hover", [setting])
