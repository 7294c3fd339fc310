"""The shipped scenarios, campaigns, papers and controllers by name; found without heavy imports.

A name is that of a file of the library, or of a row of `variants.toml`, which changes fields of a file. `Catalogue` is
what `quadsim list` prints.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, Final, Literal, TypeAlias, get_args

from quadsim.assets import library_dir, read_toml, vehicle_names, vehicle_path
from quadsim.console.results import Shown, Tabular
from quadsim.errors import FileError, UnknownNameError
from quadsim.outputs import SUMMARY_FILE

_LIBRARY: Final = library_dir()
FLIGHTS: Final = _LIBRARY / "flights"
CAMPAIGNS: Final = _LIBRARY / "campaigns"
PAPERS: Final = _LIBRARY / "papers"
VARIANTS: Final = _LIBRARY / "variants.toml"

Group = Literal["paper", "papers", "courses", "air", "faults", "ground", "space", "sensors", "other"]

_MARKS: Final = {"violated": "  (meant to violate a constraint)", "lost": "  (meant to be lost)"}
"""By expected verdict, what the list says of scenarios that are meant to defeat their controller."""
_DESCRIBED: Final = ("campaigns", "vehicles", "controllers", "papers", "solvers")
"""Kinds that the catalogue has as descriptions by name."""


def _names(folder: Path) -> list[str]:
    """Return the names of the files in a folder, sorted."""
    return sorted(path.stem for path in folder.glob("*.toml"))


def _path(kind: str, folder: Path, name: str, others: Iterable[str] = ()) -> Path:
    """Return the file of a shipped name, or the path itself if it ends in `.toml`; raise if it does not exist."""
    if name.endswith(".toml"):
        if not Path(name).is_file():
            raise FileError(name, f"no such {kind} file")
        return Path(name)
    if name not in _names(folder):
        raise UnknownNameError(kind, name, [*_names(folder), *others], hint="or give a path ending in .toml")
    return folder / f"{name}.toml"


@dataclass(frozen=True, kw_only=True)
class Variant:
    """A row of `variants.toml`: a scenario file of the library with other values of some fields."""

    base: str  # name of the file
    description: str  # one sentence
    set: Mapping[str, Any]  # values by dotted path, as after `--set`


_FIELDS_OF_VARIANT: Final = {"base": (str, "a text"), "description": (str, "a text"), "set": (dict, "a table")}


def read_variants(path: Path) -> dict[str, Variant]:
    """Read a table of variants; the fields that they set are checked where a variant is loaded.

    Raises:
        FileError: a row is malformed, has the name of a file, or a base that is none.
    """
    files = _names(FLIGHTS)
    rows = {}
    for name, row in read_toml(path).items():
        if name in files:
            raise FileError(path, f"{name} must not have the name of a file in {FLIGHTS.name}/")
        if not isinstance(row, dict) or row.keys() != _FIELDS_OF_VARIANT.keys():
            raise FileError(path, f"{name} must be a table of {', '.join(_FIELDS_OF_VARIANT)}; got {row!r:.200}")
        for key, (kind, rule) in _FIELDS_OF_VARIANT.items():
            if not isinstance(row[key], kind) or not row[key]:
                raise FileError(path, f"{name}.{key} must be {rule} that is not empty; got {row[key]!r}")
        if row["base"] not in files:
            raise FileError(path, f"{name}.base: {UnknownNameError('scenario file', row['base'], files)}")
        rows[name] = Variant(**row)
    return rows


@cache
def variants() -> Mapping[str, Variant]:
    """Return the variants of the library's scenarios by name, in the order of their table."""
    return read_variants(VARIANTS)


def scenario_names() -> list[str]:
    """Return the names of the library's scenarios, variants included, sorted."""
    return sorted([*_names(FLIGHTS), *variants()])


def names_directory(target: str | Path) -> bool:
    """Return whether a target means a directory: a run, or any that has not the name of a scenario."""
    directory = Path(target)
    if not directory.is_dir():
        return False
    return str(target) not in scenario_names() or (directory / SUMMARY_FILE).is_file()


Source: TypeAlias = tuple[Path, Mapping[str, Any]]
"""What is read: a file, and by dotted path what a variant changes there; nothing if it is the file itself."""


def scenario_source(name: str) -> Source:
    """Return where a scenario of the library, or of a path ending in `.toml`, is read from.

    Raises:
        FileError, UnknownNameError: there is none.
    """
    row = variants().get(name)
    if row is None:
        return _path("scenario", FLIGHTS, name, variants()), {}
    return FLIGHTS / f"{row.base}.toml", {**row.set, "name": name, "description": row.description}


def source_label(source: Source) -> str:
    """Return what messages call it: a file's name, or the table of variants and its row."""
    file, changes = source
    if changes:
        return f"{VARIANTS.name}, {changes['name']}"
    return file.name


campaign_names = partial(_names, CAMPAIGNS)
campaign_path = partial(_path, "campaign", CAMPAIGNS)
paper_names = partial(_names, PAPERS)
paper_path = partial(_path, "paper", PAPERS)


@dataclass(frozen=True, kw_only=True)
class LibraryScenario:
    """A shipped scenario."""

    description: str  # one sentence
    group: Group  # its group of examples
    expect: str  # expected verdict: satisfied, violated or lost
    variant: Variant | None = None  # its base and what it sets; None: it has a file of its own

    @property
    def line(self) -> str:
        """Its line in the list."""
        return self.description + _MARKS.get(self.expect, "")


@dataclass(frozen=True, kw_only=True, repr=False)
class Catalogue(Tabular):
    """Everything shipped, by name."""

    scenarios: Mapping[str, LibraryScenario]  # for `load` and `fly`
    campaigns: Mapping[str, str]  # for `campaign`; the values here and below are one-line descriptions
    vehicles: Mapping[str, str]  # for `load_vehicle` and `vehicle.file`
    controllers: Mapping[str, str]  # for `controller.type`
    papers: Mapping[str, str]  # for `reproduce`, by their titles
    solvers: Mapping[str, str]  # for `controller.solver`; those that are not installed are marked

    def shown(self) -> Shown:
        """See `Result.shown`; a variant stands below its base, indented."""
        from quadsim.console import console

        lines_by_title: dict[str, Mapping[str, str]] = {}
        for group in get_args(Group):
            lines = self._lines_of(group)
            if lines:
                lines_by_title[f"scenarios: {group}"] = lines
        for title in _DESCRIBED:
            lines_by_title[title] = getattr(self, title)
        return console.listing(lines_by_title)

    def _lines_of(self, group: Group) -> dict[str, str]:
        """Return the lines of a group's scenarios by name, each with its variants below it, indented."""
        lines = {}
        for name, entry in self.scenarios.items():
            if entry.group != group or entry.variant is not None:
                continue
            lines[name] = entry.line
            for variant_name, other in self.scenarios.items():
                if other.variant is not None and other.variant.base == name:
                    lines[f"  {variant_name}"] = other.line
        return lines

    def records(self) -> list[dict[str, Any]]:
        """Return a row per name: its `kind`, `group` of a scenario, and `description`."""
        rows: list[dict[str, Any]] = []
        for name, entry in self.scenarios.items():
            rows.append({"kind": "scenario", "name": name, "group": entry.group, "description": entry.description})
        for title in _DESCRIBED:
            for name, text in getattr(self, title).items():
                rows.append({"kind": title.removesuffix("s"), "name": name, "group": None, "description": text})
        return rows

    def to_json(self) -> dict[str, Any]:
        """Return plain values; those of scenarios by field."""
        descriptions = {}
        groups = {}
        expected = {}
        rows = {}
        for name, entry in self.scenarios.items():
            descriptions[name] = entry.description
            groups[name] = entry.group
            expected[name] = entry.expect
            if entry.variant is not None:
                rows[name] = {"base": entry.variant.base, "set": entry.variant.set}
        values: dict[str, Any] = {
            "scenarios": descriptions,
            "groups": groups,
            "expected": expected,
            "variants": rows,
        }
        for title in _DESCRIBED:
            values[title] = dict(getattr(self, title))
        return values


def read_catalogue() -> Catalogue:
    """Read everything shipped, without checking the files."""
    from quadsim.mpc.laws import laws
    from quadsim.mpc.solvers import solver_entries
    from quadsim.vehicle import load_vehicle

    scenarios = {}
    for name in scenario_names():
        file, changes = scenario_source(name)
        read = {"group": "other", "expect": "satisfied", **read_toml(file), **changes}
        scenarios[name] = LibraryScenario(
            description=read["description"], group=read["group"], expect=read["expect"], variant=variants().get(name)
        )
    return Catalogue(
        scenarios=scenarios,
        campaigns={name: read_toml(campaign_path(name))["description"] for name in campaign_names()},
        vehicles={name: load_vehicle(vehicle_path(name)).description for name in vehicle_names()},
        controllers={name: table.description for name, table in laws().items()},
        papers={name: read_toml(paper_path(name))["title"] for name in paper_names()},
        solvers={name: entry.line for name, entry in solver_entries().items()},
    )
