"""Find, read, change and check scenario files.

The start of a flight: a name of the library or a path, and changes as `--set` takes them, become a frozen `Scenario`.
A file's `base` is read first, then the file itself, then the changes; every invalid field is named at once.
`quadsim.scenarios.assembly` builds the parts of what is returned.
"""

from __future__ import annotations

import contextlib
import copy
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from quadsim.console.results import Document
from quadsim.errors import FileError, InputError
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.catalogue import scenario_names, scenario_source, source_label
from quadsim.scenarios.courses.csv_course import Csv
from quadsim.scenarios.preflight import checked
from quadsim.scenarios.schema.bases import locate_files, read_scenario, replaced_tables, retyped
from quadsim.scenarios.schema.problems import ScenarioError
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.scenarios.schema.settings import apply_setting
from quadsim.scenarios.schema.writing import plain


def load_scenario(
    source: Scenario | str | Path, changes: Mapping[str, Any] | Sequence[str] = (), seed: int | None = None
) -> Scenario:
    """Return the scenario of `assemble`; see `quadsim.commands.app.load`.

    Examples:
        >>> from quadsim.scenarios.loading import load_scenario
        >>> load_scenario("hover", ["duration=2.0", "controller.horizon=30"]).controller.horizon
        30
    """
    return assemble(source, changes, seed).scenario


def assemble(
    source: Scenario | str | Path, changes: Mapping[str, Any] | Sequence[str] = (), seed: int | None = None
) -> Assembly:
    """Return a scenario, given as an object, name or file, with changed fields, its vehicle and course, all checked.

    Args:
        source: a scenario, name or file; a file is merged over its `base`, if any.
        changes: values by dotted path, or `dotted.path=value` texts, values as in TOML, that replace or add fields.
        seed: replaces the scenario's.

    Raises:
        InputError: the file is missing or malformed, a field is invalid, or a part that it names cannot be flown.
    """
    is_file = isinstance(source, str | Path)
    by_path: dict[Any, Any] = {}
    settings: list[str] = []
    if isinstance(changes, Mapping):
        by_path |= changes
    else:
        settings += changes
    if settings and not is_file:
        raise InputError("changes of a Scenario are a mapping: {'controller.horizon': 30}")
    if seed is not None:
        if isinstance(changes, Mapping) or not is_file:
            by_path["seed"] = seed
        else:
            settings.append(f"seed={seed}")
    if isinstance(source, str | Path) and Path(source).is_dir() and str(source) not in scenario_names():
        raise InputError(f"{source} is a directory; give a scenario's name or its TOML file")
    try:
        if isinstance(source, str | Path):
            scenario = _read(str(source), settings)
        else:
            scenario = source
        if by_path:
            scenario = scenario.replace(by_path)
        return checked(Assembly(scenario))
    except OSError as error:  # of looking whether a file is there, e.g. under a name longer than the system takes
        raise FileError(str(error.filename)[:100], f"cannot be read ({error.strerror})") from error


def _read(name: str, settings: Sequence[str]) -> Scenario:
    """Return the scenario of a name or file, with `dotted.path=value` texts applied to its tables."""
    data = read_scenario(name)
    file, changes = scenario_source(name)
    label = source_label((file, changes))
    unchanged = copy.deepcopy(data)
    apply_settings(data, settings, file.parent)
    try:
        return parse_scenario(data, source=label, directory=file.parent)
    except ScenarioError as error:
        causes = _explain_types(error.problems, name, unchanged, data)
        raise ScenarioError(label, [*error.problems, *causes]) from None


def apply_settings(data: dict[str, Any], settings: Sequence[str], directory: Path) -> None:
    """Apply `dotted.path=value` texts to a file's tables in place; paths are also looked up in `directory`.

    Raises:
        InputError: a text is malformed, or its path leads nowhere.
    """
    defaults = None
    if settings:
        with contextlib.suppress(InputError, OSError):  # a file may be complete with its settings alone
            defaults = plain(parse_scenario(data, directory=directory))
    for setting in settings:
        apply_setting(data, setting, defaults)


def _explain_types(
    problems: Sequence[str], name: str, read: Mapping[str, Any], data: Mapping[str, Any]
) -> Iterator[str]:
    """Explain why a table lacks fields or has too many: its type differs from that in the file."""
    lacking = set()
    exceeding = set()
    for problem in problems:
        table = problem.partition(".")[0]
        if problem.endswith(" is missing"):
            lacking.add(table)
        elif " is not a field of " in problem:
            exceeding.add(table)
    types_before = retyped(read, data)
    for table, before in types_before.items():
        if table in lacking | exceeding:
            changed = f"--set changed its type from {before!r} to {data[table]['type']!r}, and all other fields stayed"
            base = Path(name).name
            yield f'{table}: {changed}; a file with base = "{base}" and a whole [{table}] replaces them'
    file, _ = scenario_source(name)
    for table, before in replaced_tables(file).items():
        if table in lacking and table not in types_before:
            other = f"of another type than that of its base ({before})"
            yield f"{table}: {other}, it replaces it whole and inherits nothing"


class ScenarioFile(Document):
    """The text of a scenario file."""

    @property
    def scenario(self) -> Scenario:
        """The parsed scenario, with the numbers of its vehicle's file recorded."""
        return Assembly(parse_scenario(tomllib.loads(self.content))).recorded.scenario

    def to_json(self) -> Any:
        """Return its tables."""
        if self.data is None:
            return tomllib.loads(self.content)
        return self.data


def parse_scenario(data: Mapping[str, Any], *, source: str = "scenario", directory: Path | None = None) -> Scenario:
    """Check a scenario given as nested tables, called `source` in messages.

    Relative paths of vehicles and courses, and modules of plug-ins, are also looked up in `directory`.

    Raises:
        ScenarioError: names every invalid field.
        FileError: the course's table is invalid.
    """
    if directory is not None:
        tables = {}
        for name, value in data.items():
            if isinstance(value, dict):
                tables[name] = {**value}  # the caller's stay as they are
            else:
                tables[name] = value
        locate_files(tables, directory)
        data = tables
    scenario = Scenario.parse(data, source=source)
    if directory is not None and isinstance(scenario.reference, Csv):
        scenario = scenario.altered(reference=scenario.reference.located(directory))
    return scenario
