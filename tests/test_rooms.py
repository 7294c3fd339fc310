"""Rooms: the core names none, none names another, each can be taken away."""

from __future__ import annotations

import ast
import inspect
from functools import cache
from pathlib import Path

import pytest
import rooms as taking
from test_architecture import PACKAGES, Import, imports_of, modules

import quadsim
from scenarios.commands.rooms import ROOMS, commands_of

MOST_USED = 296
"""Names of the core that rooms import, each counted once; they may only get fewer."""
LISTS = ("quadsim", "quadsim.gym", "scenarios.commands.rooms")
"""Where a room is named: what users import, and the list of the rooms."""


def room_of(module: str) -> str | None:
    return next((room for room in ROOMS if f"{module}.".startswith(f"scenarios.{room}.")), None)


@pytest.fixture(scope="module")
def imports() -> list[Import]:
    ours = modules()
    return [item for name, path in ours.items() for item in imports_of(name, path.read_text(), set(ours))]


def test_every_room_is_a_folder_with_tests() -> None:
    root = Path(taking.__file__).resolve().parent
    assert set(taking.PARTS) >= set(ROOMS)
    for room in ROOMS:
        tested = (root / "scenarios" / room, *(root.parent / part for part in taking.PARTS[room] if "tests" in part))
        assert (root.parent / "scenarios" / room / "__init__.py").is_file()
        assert any(folder.is_dir() for folder in tested), room


def test_the_core_names_no_room_and_no_room_names_another(imports: list[Import]) -> None:
    """Imports in functions and for typing count too."""
    wrong = [
        f"{item.importer} imports {item.imported}"
        for item in imports
        if (room := room_of(item.imported)) is not None
        and room_of(item.importer) != room
        and item.importer not in LISTS
    ]
    assert wrong == []


def test_rooms_use_few_names_of_the_core() -> None:
    used = {
        (node.module, name.name)
        for module, path in modules().items()
        if (room := room_of(module)) is not None
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith(PACKAGES)
        if room_of(str(node.module)) != room
        for name in node.names
    }
    assert 0 < len(used) <= MOST_USED, sorted(used)


TESTS = Path(taking.__file__).resolve().parent
COMMANDS = {word: room for room, entry in ROOMS.items() for word in entry.commands}
NAMED = {
    **{f"scenarios.{room}": room for room in ROOMS},
    **{f"quadsim.{name}": room for name, module in quadsim._PUBLIC.items() if (room := room_of(module))},
    **{"mpc.codegen": "export", "quadsim.gym": "gym"},
}
"""Rooms by the dotted names that lead into them."""


@cache
def used_by(test: Path) -> frozenset[str]:
    """The rooms that a module of tests names: in imports, its helpers' too, as `quadsim.NAME`, as a command's word."""
    names: set[str] = set()
    words: set[object] = set()
    for node in ast.walk(ast.parse(test.read_text(encoding="utf-8"))):
        match node:
            case ast.ImportFrom(module=str(module)):
                names |= {module, *(f"{module}.{item.name}" for item in node.names)}
            case ast.Import():
                names |= {item.name for item in node.names}
            case ast.Attribute(value=ast.Name(id="quadsim"), attr=name):
                names.add(f"quadsim.{name}")
            case ast.Call(func=ast.Name(id="main"), args=[ast.List(elts=[ast.Constant(value=word), *_]), *_]):
                words.add(word)
    rooms = {room for start, room in NAMED.items() if any(f"{name}.".startswith(f"{start}.") for name in names)}
    helpers = {path for name in names - {test.stem, "rooms"} if (path := TESTS / f"{name}.py").is_file()}
    return frozenset(rooms.union({COMMANDS[word] for word in words & {*COMMANDS}}, *map(used_by, helpers)))


def test_what_tests_use_of_other_rooms_is_stated() -> None:
    """So that they are left out without it; `taking.USING` states it."""
    apart = {TESTS / "peers", TESTS / "firmware"}
    parts = {room: {TESTS.parent / part for part in (f"tests/scenarios/{room}", *taking.PARTS[room])} for room in ROOMS}
    missing = {}
    for path in TESTS.rglob("test_*.py"):
        name, folders = path.relative_to(TESTS).as_posix(), {path, *path.parents}
        own = {room for room in ROOMS if folders & parts[room]}
        rooms = used_by(path) - own - {*taking.USING.get(name, ())}
        if rooms and not folders & apart:
            missing[name] = sorted(rooms)
    assert missing == {}


def test_the_list_of_commands_says_what_the_rooms_say() -> None:
    for name, room in ROOMS.items():
        for command in room.commands.values():
            function = getattr(commands_of(name), command.function)
            assert inspect.getdoc(function).splitlines()[0] == command.help
        if room.owns_directories:
            assert {"owns", "check_advice", "compare_directories"} <= set(dir(commands_of(name)))


def test_without_any_room_the_rest_lists_and_flies(tmp_path: Path) -> None:
    """In a copy; `make rooms` takes each away by itself, and runs the tests too."""
    taking.copy_without(ROOMS, tmp_path)
    rooms = (tmp_path / "scenarios" / "commands" / "rooms.py").read_text().split("ROOMS")[1].split('"')
    for room in ROOMS:
        assert not (tmp_path / "scenarios" / room).exists()
        assert room not in rooms
    assert taking.failure_of(taking.COMMANDS, tmp_path) is None
