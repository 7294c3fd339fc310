"""Fields of a scenario's tables by dotted path, as `--set` replaces them and a campaign draws them.

`set_field` changes one in place, and with it what the tables say about themselves: which numbers repeat the vehicle's
file (`restate`), which bounds constraints took from a controller (`state_bounds`), and the description.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Final

from annotated_types import MaxLen, doc

from quadsim.assets import DEEPEST, parse_toml
from quadsim.errors import InputError, ParameterError, UnknownNameError
from quadsim.input_limits import MOST_ENTRIES

_CHANGED: Final = " (changed: "  # start of the list of changes at the end of a description
NOT_DESCRIBED: Final = ("name", "description", "group", "expect", "seed")
"""Fields whose changes a description does not list."""
RECORDED: Final = "recorded"
REPEATING: Final = ("vehicle", "autopilot")
"""The table that says that a scenario repeats its vehicle's file, and the tables that do."""
_LONGEST: Final = 60  # characters of a value that a description shows


@dataclass(frozen=True, kw_only=True)
class RecordedVehicle:
    """Numbers of the vehicle file that [vehicle] and [autopilot] repeat, to fly alike without it; written by runs."""

    file: Annotated[str, doc("the vehicle file they are of, vehicle.file; with another one they are left out")]
    stated: Annotated[
        tuple[str, ...],
        MaxLen(MOST_ENTRIES),
        doc("fields of [vehicle] and [autopilot] that are no repetition, as vehicle.mass"),
    ] = ()


def apply_setting(data: dict[str, Any], setting: str, defaults: Mapping[str, Any] | None = None) -> None:
    """Apply one `dotted.path=value` to a scenario's tables, with their `defaults`; see `set_field`.

    Raises:
        ParameterError: the text is not of that form, or the path leads through something that is not a table.
    """
    path, equals, text = setting.partition("=")
    keys = path.strip().split(".")
    if not equals or not all(keys):
        raise ParameterError("", "--set", setting, "of the form dotted.path=value")
    if keys == ["base"]:
        raise ParameterError("", "--set", setting, "of a field other than base, which only a file can have")
    try:
        if len(keys) > DEEPEST:
            raise InputError
        value = _parse_value(text.strip())
    except InputError:
        rule = f"of at most {DEEPEST} tables and lists within one another"
        raise ParameterError("", "--set", setting[:100], rule) from None
    set_field(data, path.strip(), value, source="--set", given=setting, defaults=defaults)


def set_field(
    data: dict[str, Any],
    path: str,
    value: Any,
    *,
    source: str,
    given: str | None = None,
    defaults: Mapping[str, Any] | None = None,
) -> None:
    """Replace or add a field, and say so in the scenario's description; missing tables on the path are added.

    An entry of a list of tables is addressed by its name, as in `constraints.roll.upper`, or, where it has none, by its
    index, as in `events.0.at`; a number of a list by its index, as in `initial.euler.2`.

    Args:
        data: what was stated, changed in place.
        path: dotted path of the field.
        value: its new value; None removes the field.
        source: who asks, for the message.
        given: the request as written, for the message; the path by default.
        defaults: the same tables with every default, which have the lists that `data` leaves to them.

    Raises:
        ParameterError: the path leads through something that is not a table.
        UnknownNameError: a list does not have the entry.
    """
    if path == "controller":
        state_bounds(data, value)
    elif path == "controller.type":
        state_bounds(data, {"type": value})
    restate(data, path, value)
    *through, last = path.split(".")
    holder = _holder(data, through, source=source, given=given or path, defaults=defaults)
    if isinstance(holder, dict) and value is None:
        holder.pop(last, None)
    elif isinstance(holder, dict):
        holder[last] = copy.deepcopy(value)  # later changes must not reach the caller's tables
    else:
        _require_numbers(holder, path, source=source, given=given or path)
        holder[_index(holder, ".".join(through), last)] = value
    note_change(data, path, value)


def restate(data: dict[str, Any], path: str, value: Any) -> None:
    """Before a field gets a value, drop what repeats a file that `path` replaces, and note what is stated from now on.

    With another vehicle file go the values recorded from the file before, and with another course file its hash.  A
    recorded value that is replaced is stated.
    """
    table, _, field = path.partition(".")
    reference = data.get("reference")
    vehicle = data.get("vehicle")
    recorded = data.get(RECORDED)
    if path == "reference.file" and isinstance(reference, dict) and reference.get("file") != value:
        reference.pop("sha256", None)
    if not (isinstance(recorded, dict) and isinstance(vehicle, dict)):
        return
    stated = recorded.get("stated", [])
    if path == "vehicle" or (path == "vehicle.file" and vehicle.get("file") != value):
        for name in REPEATING:
            kept = {}
            for key, number in _table(data, name).items():
                if f"{name}.{key}" in stated:
                    kept[key] = number
            data[name] = kept
        del data[RECORDED]
        if not data["autopilot"]:
            del data["autopilot"]
    elif table in REPEATING and field != "file":
        if field:
            names = [field.partition(".")[0]]
        else:
            names = [*_table({table: value}, table)]
        stated_now = [*stated]
        for name in names:
            if f"{table}.{name}" not in stated:
                stated_now.append(f"{table}.{name}")
        data[RECORDED] = {**recorded, "stated": stated_now}


def separate(changes: Mapping[Any, Any], *, source: str) -> dict[str, Any]:
    """Return changes by field: a tuple of fields shares one value, or has a tuple of one value per field.

    Raises:
        ParameterError: a tuple of values has another length than its fields.
    """
    separated: dict[str, Any] = {}
    for fields, value in changes.items():
        if isinstance(fields, str):
            separated[fields] = value
            continue
        if isinstance(value, tuple):
            values = value
        else:
            values = (value,) * len(fields)
        if len(values) != len(fields):
            rule = f"one value for all, or a tuple of {len(fields)}; a pair for all is a list"
            raise ParameterError(source, f"({', '.join(fields)})", value, rule)
        separated |= zip(fields, values, strict=True)
    return separated


def state_bounds(data: dict[str, Any], controller: Any) -> None:
    """Write the bounds that constraints took from a controller into them, when a law without these replaces it."""
    before = data.get("controller")
    if isinstance(controller, str):
        after = {"type": controller}
    else:
        after = controller
    if not (isinstance(before, dict) and isinstance(after, dict)) or after.get("type") in (None, before.get("type")):
        return
    constraints = data.get("constraints")
    if not isinstance(constraints, list):
        return
    bounds_before = _bounds_by_signal(before)
    bounds_after = _bounds_by_signal(after)
    for entry in constraints:
        if not isinstance(entry, dict) or {"lower", "upper"} & entry.keys():
            continue
        signal = str(entry.get("signal"))
        pair = bounds_before.get(signal)
        if signal not in bounds_after and isinstance(pair, list) and len(pair) == 2:
            entry["lower"], entry["upper"] = pair


def _bounds_by_signal(controller: Mapping[str, Any]) -> dict[str, Any]:
    """Return the bounds that a controller's table states on outputs and inputs."""
    return {**_table(controller, "output_bounds"), **_table(controller, "input_bounds")}


def _table(data: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """Return a table within another one, empty where there is none."""
    table = data.get(name)
    if isinstance(table, Mapping):
        return table
    return {}


def note_change(data: dict[str, Any], path: str, value: Any) -> None:
    """Note the new value of a field in a scenario's description, if it has one; a later change replaces an earlier."""
    _note(data, [(path, value)])


def note_changes(data: dict[str, Any], changes: Mapping[str, Any]) -> None:
    """Note every field of tables that were merged over a scenario's; see `note_change`."""
    _note(data, leaves(changes))


def _note(data: dict[str, Any], changes: Iterable[tuple[str, Any]]) -> None:
    """Note changes, by path, behind those that the description has."""
    description = data.get("description")
    if not isinstance(description, str):
        return
    text, _, noted = description.partition(_CHANGED)
    if noted:
        earlier = noted.removesuffix(")").split("; ")
    else:
        earlier = []
    notes = {note.partition(" = ")[0]: note for note in earlier}
    for path, value in changes:
        if path not in NOT_DESCRIBED:
            notes.pop(path, None)
            notes[path] = f"{path} = {field_text(value)}"
    if notes:
        data["description"] = f"{text}{_CHANGED}{'; '.join(notes.values())})"


def differences(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[tuple[str, Any, Any]]:
    """Return fields in which nested tables differ: dotted path and both values, None where one lacks the field."""
    a = dict(leaves(first, entries=True))
    b = dict(leaves(second, entries=True))
    differing = []
    for path in {**a, **b}:
        if a.get(path) != b.get(path):
            differing.append((path, a.get(path), b.get(path)))
    return differing


def leaves(data: Mapping[str, Any], above: str = "", *, entries: bool = False) -> Iterator[tuple[str, Any]]:
    """Yield numbers, texts and lists of nested tables by dotted path, as in `set_field`; `entries`: also of lists."""
    for key, value in data.items():
        below: Any = value
        if isinstance(value, list | tuple):
            if _all_named(value):
                below = _by_name(value)
            elif entries:
                below = {str(i): entry for i, entry in enumerate(value)}
        if isinstance(below, Mapping):
            yield from leaves(below, f"{above}{key}.", entries=entries)
        else:
            yield above + key, below


def _all_named(entries: Sequence[Any]) -> bool:
    """Return whether a list has entries, which are tables with a name."""
    return bool(entries) and all(isinstance(entry, Mapping) and "name" in entry for entry in entries)


def _by_name(entries: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return a list's tables by their names, each without its name."""
    named = {}
    for entry in entries:
        fields = dict(entry)
        name = fields.pop("name")
        named[str(name)] = fields
    return named


def field_text(value: Any) -> str:
    """Return a value on one line, numbers to six digits; None is an absent field."""
    if value is None:
        return "absent"
    try:
        if isinstance(value, float):
            text = f"{value:.6g}"
        else:
            text = json.dumps(value, default=str)
    except ValueError:  # Python does not write out very long whole numbers
        return "..."
    text = text.replace("; ", ", ")
    if len(text) <= _LONGEST:
        return text
    return f"{text[: _LONGEST - 3]}..."


def get_field(data: dict[str, Any], path: str) -> Any:
    """Return the value of a field, or None where it is absent.

    Raises:
        ParameterError, UnknownNameError: as `set_field`.
    """
    *through, last = path.split(".")
    holder = _holder(data, through, source="field", given=path)
    if isinstance(holder, dict):
        return holder.get(last)
    _require_numbers(holder, path, source="field", given=path)
    return holder[_index(holder, ".".join(through), last)]


def _holder(
    data: dict[str, Any],
    through: list[str],
    *,
    source: str,
    given: str,
    defaults: Mapping[str, Any] | None = None,
) -> dict[str, Any] | list[Any]:
    """Return the table or list at the end of a path; `defaults` has the lists that `data` leaves to them."""
    holder: Any = data
    default: Any = defaults
    for depth, key in enumerate(through):
        if isinstance(holder, list):
            i = _index(holder, ".".join(through[:depth]), key)
            if isinstance(default, list) and i < len(default):
                default = default[i]
            else:
                default = None
            holder = holder[i]
        else:
            if key == "controller" and isinstance(holder.get(key), str):  # its name alone
                holder[key] = {"type": holder[key]}
            default = _default_of(holder, key, default)
            if key not in holder and isinstance(default, list):
                holder[key] = copy.deepcopy(default)
            holder = holder.setdefault(key, {})
        if not isinstance(holder, dict | list) or holder == []:
            raise ParameterError("", source, given, f"a path to a field; {key} has none")
    return holder


def _default_of(table: Mapping[str, Any], key: str, defaults: Any) -> Any:
    """Return the default of a table's field; None where there is none, or the defaults are those of another type."""
    if not isinstance(defaults, Mapping):
        return None
    type_of_defaults = defaults.get("type")
    if table.get("type", type_of_defaults) != type_of_defaults:
        return None
    return defaults.get(key)


def _index(entries: list[Any], where: str, key: str) -> int:
    """Return the position of a list's entry from its name, or from its index."""
    names = []
    for i, entry in enumerate(entries):
        if isinstance(entry, dict):
            names.append(str(entry.get("name", i)))
        else:
            names.append(str(i))
    if key not in names:
        raise UnknownNameError(f"entry of {where}", key, names)
    return names.index(key)


def _require_numbers(entries: list[Any], path: str, *, source: str, given: str) -> None:
    """Refuse a path that ends at an entry which is a table."""
    if any(isinstance(entry, dict | list) for entry in entries):
        raise ParameterError("", source, given, f"a path to a field; {path} is an entry of a list")


def _parse_value(text: str) -> Any:
    """A value of TOML, or the text itself where it is none."""
    try:
        table = parse_toml(f"value = {text}")
    except InputError:
        raise
    except ValueError:  # also of a number of thousands of digits
        return text
    if table.keys() == {"value"}:
        return table["value"]
    return text
