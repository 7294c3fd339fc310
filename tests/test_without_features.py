"""Features: the core names none, none names another, each can be taken away."""

from __future__ import annotations

import ast
import inspect
from functools import cache
from pathlib import Path

import pytest
import without_features as taking
from test_architecture import Import, imports_of, modules

import quadsim
from quadsim.features.entries import FEATURES, commands_of

LISTS = ("quadsim", "quadsim.gym", "quadsim.features.entries")
"""Where a feature is named: what users import, and the list of the features."""


def feature_of(module: str) -> str | None:
    return next((feature for feature in FEATURES if f"{module}.".startswith(f"quadsim.features.{feature}.")), None)


@pytest.fixture(scope="module")
def imports() -> list[Import]:
    ours = modules()
    return [item for name, path in ours.items() for item in imports_of(name, path.read_text(), set(ours))]


def test_every_feature_is_a_folder_with_tests() -> None:
    root = Path(taking.__file__).resolve().parent
    assert set(taking.PARTS) >= set(FEATURES)
    for feature in FEATURES:
        tested = (
            root / "features" / feature,
            *(root.parent / part for part in taking.PARTS[feature] if "tests" in part),
        )
        assert (root.parent / "quadsim" / "features" / feature / "__init__.py").is_file()
        assert any(folder.is_dir() for folder in tested), feature


def test_the_core_names_no_feature_and_no_feature_names_another(imports: list[Import]) -> None:
    """Imports in functions and for typing count too."""
    wrong = [
        f"{item.importer} imports {item.imported}"
        for item in imports
        if (feature := feature_of(item.imported)) is not None
        and feature_of(item.importer) != feature
        and item.importer not in LISTS
    ]
    assert wrong == []


TESTS = Path(taking.__file__).resolve().parent
COMMANDS = {word: feature for feature, entry in FEATURES.items() for word in entry.commands}
NAMED = {
    **{f"quadsim.features.{feature}": feature for feature in FEATURES},
    **{f"quadsim.{name}": feature for name, module in quadsim._PUBLIC.items() if (feature := feature_of(module))},
    **{"quadsim.mpc.export": "export", "quadsim.gym": "gym"},
}
"""Features by the dotted names that lead into them."""


@cache
def used_by(test: Path) -> frozenset[str]:
    """The features that a module of tests names: in imports, its helpers' too, as `quadsim.NAME`, as a command."""
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
    features = {
        feature for start, feature in NAMED.items() if any(f"{name}.".startswith(f"{start}.") for name in names)
    }
    helpers = {path for name in names - {test.stem, "without_features"} if (path := TESTS / f"{name}.py").is_file()}
    return frozenset(features.union({COMMANDS[word] for word in words & {*COMMANDS}}, *map(used_by, helpers)))


def test_what_tests_use_of_other_features_is_stated() -> None:
    """So that they are left out without it; `taking.USING` states it."""
    apart = {TESTS / "peers", TESTS / "firmware"}
    parts = {
        feature: {TESTS.parent / part for part in (f"tests/features/{feature}", *taking.PARTS[feature])}
        for feature in FEATURES
    }
    missing = {}
    for path in TESTS.rglob("test_*.py"):
        name = path.relative_to(TESTS).as_posix()
        folders = {path, *path.parents}
        own = {feature for feature in FEATURES if folders & parts[feature]}
        features = used_by(path) - own - {*taking.USING.get(name, ())}
        if features and not folders & apart:
            missing[name] = sorted(features)
    assert missing == {}


def test_the_list_of_commands_says_what_the_features_say() -> None:
    for name, feature in FEATURES.items():
        for command in feature.commands.values():
            function = getattr(commands_of(name), command.function)
            assert inspect.getdoc(function).splitlines()[0] == command.help
        if feature.owns_directories:
            assert {"owns", "check_advice", "compare_directories"} <= set(dir(commands_of(name)))


def test_without_any_feature_the_rest_lists_and_flies(tmp_path: Path) -> None:
    """In a copy; `make without-features` takes each away by itself, and runs the tests too."""
    taking.copy_without(FEATURES, tmp_path)
    features = (tmp_path / "quadsim" / "features" / "entries.py").read_text().split("FEATURES")[1].split('"')
    for feature in FEATURES:
        assert not (tmp_path / "quadsim" / "features" / feature).exists()
        assert feature not in features
    assert taking.failure_of(taking.COMMANDS, tmp_path) is None
