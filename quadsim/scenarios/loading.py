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
    try:
        if isinstance(source, str | Path):
            scenario = _load(str(source), changes, seed)
        else:
            scenario = _change(source, changes, seed)
        return checked(Assembly(scenario))
    except OSError as error:  # even a look for a file can fail, e.g. by a name longer than the system takes
        raise FileError(str(error.filename)[:100], f"cannot be read ({error.strerror})") from error


def _load(name: str, changes: Mapping[str, Any] | Sequence[str], seed: int | None) -> Scenario:
    """Return the scenario of a name or file, changed: by texts in its tables, or by path once parsed.

    Raises:
        InputError: as `assemble`.
    """
    if Path(name).is_dir() and name not in scenario_names():
        raise InputError(f"{name} is a directory; give a scenario's name or its TOML file")
    if isinstance(changes, Mapping):
        return _change(_read(name, ()), changes, seed)
    settings = [*changes]
    if seed is not None:
        settings.append(f"seed={seed}")
    return _read(name, settings)


def _change(scenario: Scenario, changes: Mapping[str, Any] | Sequence[str], seed: int | None) -> Scenario:
    """Return a scenario with other values by dotted path, and another seed where one is given.

    Raises:
        InputError: the changes are texts, or a value is not allowed.
    """
    by_path: dict[Any, Any] = {}
    if isinstance(changes, Mapping):
        by_path |= changes
    elif changes:
        raise InputError("changes of a Scenario are a mapping: {'controller.horizon': 30}")
    if seed is not None:
        by_path["seed"] = seed
    if not by_path:
        return scenario
    return scenario.replace(by_path)


def _read(name: str, settings: Sequence[str]) -> Scenario:
    """Return the scenario of a name or file, with `dotted.path=value` texts applied to its tables."""
    tables = read_scenario(name)
    source = scenario_source(name)
    file, _ = source
    label = source_label(source)
    tables_before = copy.deepcopy(tables)
    apply_settings(tables, settings, file.parent)
    try:
        return parse_scenario(tables, source=label, directory=file.parent)
    except ScenarioError as error:
        causes = _explain_types(error.problems, name, tables_before, tables)
        raise ScenarioError(label, [*error.problems, *causes]) from None


def apply_settings(data: dict[str, Any], settings: Sequence[str], directory: Path) -> None:
    """Apply `dotted.path=value` texts to a file's tables in place; paths are also looked up in `directory`.

    Raises:
        InputError: a text is malformed, or its path leads nowhere.
    """
    defaults = None
    if settings:
        # Before its settings, a file may lack fields; it then has no defaults yet.
        with contextlib.suppress(InputError, OSError):
            defaults = plain(parse_scenario(data, directory=directory))
    for setting in settings:
        apply_setting(data, setting, defaults)


def _explain_types(
    problems: Sequence[str], name: str, before: Mapping[str, Any], after: Mapping[str, Any]
) -> Iterator[str]:
    """Explain why a table lacks fields or has unknown ones: its type is not that for which the rest of it was written.

    Args:
        problems: what is wrong with the tables after their settings.
        name: of the scenario, or its file.
        before: the tables before their settings.
        after: the tables after them.
    """
    lacking = set()
    with_unknown = set()
    for problem in problems:
        table = problem.partition(".")[0]
        if problem.endswith(" is missing"):
            lacking.add(table)
        elif " is not a field of " in problem:
            with_unknown.add(table)
    types_before = retyped(before, after)
    for table, type_before in types_before.items():
        if table in lacking or table in with_unknown:
            type_now = after[table]["type"]
            cause = f"--set changed its type from {type_before!r} to {type_now!r}, and all other fields stayed"
            advice = f'a file with base = "{Path(name).name}" and a whole [{table}] replaces them'
            yield f"{table}: {cause}; {advice}"
    file, _ = scenario_source(name)
    for table, base_type in replaced_tables(file).items():
        if table in lacking and table not in types_before:
            cause = f"of another type than that of its base ({base_type})"
            yield f"{table}: {cause}, it replaces it whole and inherits nothing"


class ScenarioFile(Document):
    """The text of a scenario file."""

    @property
    def scenario(self) -> Scenario:
        """The parsed scenario, with the numbers of its vehicle's file recorded."""
        return Assembly(parse_scenario(tomllib.loads(self.content))).recorded.scenario

    def to_json(self) -> Any:
        """Return the data that it was given, or else the tables of its text."""
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
