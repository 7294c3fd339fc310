"""Rooms: the core names none, none names another, each can be taken away."""

from __future__ import annotations

import ast
import inspect
from pathlib import Path

import pytest
import rooms as taking
from test_architecture import PACKAGES, Import, imports_of, modules

from scenarios.commands.rooms import ROOMS, commands_of

MOST_USED = 277
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


def test_the_list_of_commands_says_what_the_rooms_say() -> None:
    for name, room in ROOMS.items():
        for command in room.commands.values():
            function = getattr(commands_of(name), command.function)
            assert inspect.getdoc(function).splitlines()[0] == command.help
        if room.owns_directories:
            assert {"owns", "check_advice", "compare_directories"} <= set(dir(commands_of(name)))


@pytest.mark.parametrize("room", ROOMS)
def test_without_a_room_the_rest_imports(room: str, tmp_path: Path) -> None:
    """The command and its list, in a copy; `make rooms` runs its tests too."""
    taking.copy_without([room], tmp_path)
    assert not (tmp_path / "scenarios" / room).exists()
    assert room not in (tmp_path / "scenarios" / "commands" / "rooms.py").read_text().split("ROOMS")[1].split('"')
    assert taking.failure_of(taking.COMMANDS, tmp_path) is None
