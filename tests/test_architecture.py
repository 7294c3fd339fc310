"""Who may import whom, and when: the arrows between the packages, and a command line that answers at once."""

from __future__ import annotations

import ast
import itertools
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("quadsim", "mpc", "scenarios")
MPC_MAY_IMPORT = {
    f"quadsim.{name}" for name in ("vehicle", "state", "rotation", "errors", "fields", "controller", "motion", "space")
}  # fmt: skip
RENDER_WORKER = "quadsim.report.film.render_worker"
"""Only ever run as a child process, so it may import at its top what is heavy."""
RECORDING = re.compile(r"quadsim\.report\.recording\.(plots|style|world)")
"""Imported when a recording is made, and so may import rerun at their top."""
FOR_DRAWING = {
    "matplotlib": r"quadsim\.report\.to_matplotlib",
    "plotly": r"quadsim\.report\.to_plotly",
}
"""Libraries to draw with, and the module that imports each."""
OF_ONE_ROOM = (
    "rerun",
    "imageio",
    "imageio_ffmpeg",
    "jinja2",
    "distributed",
    "optuna",
)
IMPORT_NAMES = {"pillow": "PIL", "rerun-sdk": "rerun"}
"""Distributions whose import name is not their own."""


@dataclass(frozen=True, kw_only=True)
class Import:
    """One module named by one import statement."""

    importer: str
    imported: str
    at_start: bool
    """Carried out as the importer is: neither in a function nor under TYPE_CHECKING."""

    @property
    def room(self) -> str:
        """The package that the importer is, or is part of, e.g. `quadsim.report.film`; in `scenarios` the feature."""
        return ".".join(self.importer.split(".")[: 3 if self.importer.startswith("quadsim") else 2])

    @property
    def library(self) -> str:
        return self.imported.partition(".")[0]


def modules() -> dict[str, Path]:
    """Our modules by dotted name."""
    files = [path for package in PACKAGES for path in (ROOT / package).rglob("*.py")]
    return {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path for path in files}


def imports_of(importer: str, source: str, ours: set[str]) -> Iterator[Import]:
    """Every import of a module's source; `from package import module` names the module."""

    def visit(node: ast.AST, at_start: bool) -> Iterator[Import]:
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{importer} imports relatively; name the package"
            members = [f"{node.module}.{alias.name}" for alias in node.names]
            names = [member if member in ours else str(node.module) for member in members]
        yield from (Import(importer=importer, imported=name, at_start=at_start) for name in names)
        typing_only = isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        later = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda) or typing_only
        for child in ast.iter_child_nodes(node):
            if not isinstance(child, ast.expr):  # none of which holds an import
                yield from visit(child, at_start and not later)

    yield from visit(ast.parse(source), True)


@pytest.fixture(scope="module")
def imports() -> list[Import]:
    ours = modules()
    found = [item for name, path in ours.items() for item in imports_of(name, path.read_text(), set(ours))]
    assert {item.importer.partition(".")[0] for item in found} == set(PACKAGES)
    return found


def loaded_by(code: str) -> set[str]:
    """Top-level names of all modules that a fresh interpreter has loaded after some code."""
    report = "import sys\nprint(*{name.partition('.')[0] for name in sys.modules}, file=sys.stderr)"
    command = [sys.executable, "-c", f"{code}\n{report}"]
    return set(subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stderr.split())


def declared() -> set[str]:
    """Import names of the run-time dependencies in pyproject.toml, optional ones included."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    requirements = [*project["dependencies"], *itertools.chain(*project["optional-dependencies"].values())]
    names = [re.split(r"[<>=!~\[; ]", requirement, maxsplit=1)[0] for requirement in requirements]
    return {IMPORT_NAMES.get(name, name.replace("-", "_")) for name in names}


def test_imports_are_distinguished() -> None:
    source = (
        "import a.b\nfrom typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import c\nelse:\n    pass\n"
        "class K:\n    import d\n    def f(self):\n        from quadsim import state, __version__\n"
    )
    found = {(item.imported, item.at_start) for item in imports_of("x", source, {"quadsim", "quadsim.state"})}
    assert found == {
        ("a.b", True),
        ("typing", True),
        ("c", False),
        ("d", True),
        ("quadsim.state", False),
        ("quadsim", False),
    }


def test_the_testbed_imports_nothing_of_ours(imports: list[Import]) -> None:
    """But for `import quadsim` and `import quadsim.gym`, which hand out what users call, late."""
    found = [i for i in imports if i.importer.startswith("quadsim") and i.library in {"mpc", "scenarios", "piqp"}]
    assert {i.importer for i in found} == {"quadsim", "quadsim.gym"}
    assert not [i for i in found if i.at_start]


def test_controllers_know_vehicle_state_errors_and_protocol_alone(imports: list[Import]) -> None:
    named = {i.imported for i in imports if i.importer.startswith("mpc")}
    assert {name for name in named if name.startswith(("quadsim", "scenarios"))} <= MPC_MAY_IMPORT
    assert "mujoco" not in {name.partition(".")[0] for name in named}


def test_controllers_run_without_a_simulator() -> None:
    optional = {"mpc.solvers.daqp_dense": "daqp", "mpc.solvers.qpsolvers_backend": "qpsolvers"}
    loaded = loaded_by("import " + ", ".join(name for name in set(modules()) - set(optional) if name.startswith("mpc")))
    assert {"mpc", "quadsim", "piqp"} <= loaded
    assert not loaded & {"mujoco", "scenarios", "pydantic", *OF_ONE_ROOM, *FOR_DRAWING, *optional.values()}


@pytest.mark.parametrize("library", OF_ONE_ROOM)
def test_a_library_for_outputs_is_imported_in_one_room_and_late(library: str, imports: list[Import]) -> None:
    uses = [item for item in imports if item.library == library]
    assert len({item.room for item in uses}) <= 1
    assert not [i for i in uses if i.at_start and i.importer != RENDER_WORKER and not RECORDING.fullmatch(i.importer)]


def test_what_records_is_imported_late(imports: list[Import]) -> None:
    uses = [item for item in imports if RECORDING.fullmatch(item.imported)]
    assert not [i for i in uses if i.at_start and not RECORDING.fullmatch(i.importer)]


@pytest.mark.parametrize("library", FOR_DRAWING)
def test_a_library_to_draw_with_is_imported_by_its_renderer_alone_and_late(library: str, imports: list[Import]) -> None:
    uses = [item for item in imports if item.library == library]
    assert not [item for item in uses if item.at_start or not re.fullmatch(FOR_DRAWING[library], item.importer)]


def test_gymnasium_is_imported_by_the_environments_alone(imports: list[Import]) -> None:
    assert {i.room for i in imports if i.library == "gymnasium"} == {"scenarios.gym"}


def test_the_render_worker_is_imported_by_nobody(imports: list[Import]) -> None:
    assert RENDER_WORKER in modules()
    assert RENDER_WORKER not in {item.imported for item in imports}


LONGEST_CHAIN = 15
"""Modules that a reader follows at most from an import to what it stands on."""


def test_no_module_and_no_folder_imports_what_imports_it(imports: list[Import]) -> None:
    ours = modules()
    packages = {"", *(name.rpartition(".")[0] for name in ours if "." in name)}
    for package in packages:
        within = f"{package}." if package else ""
        graph: dict[str, set[str]] = {}
        for item in imports:
            if item.at_start and item.imported in ours and item.importer.startswith(within):
                importer, imported = (
                    name.removeprefix(within).partition(".")[0] for name in (item.importer, item.imported)
                )
                if item.imported.startswith(within) and imported != importer:
                    graph.setdefault(importer, set()).add(imported)
        tuple(TopologicalSorter(graph).static_order())  # raises where there is a cycle


def test_no_chain_of_imports_is_long(imports: list[Import]) -> None:
    ours = modules()
    graph: dict[str, set[str]] = {name: set() for name in ours}
    for item in imports:
        if item.at_start and item.imported in ours and item.imported != item.importer:
            graph[item.importer].add(item.imported)
    depth: dict[str, int] = {}
    for name in TopologicalSorter(graph).static_order():
        depth[name] = 1 + max((depth[imported] for imported in graph[name]), default=0)
    assert max(depth.values()) <= LONGEST_CHAIN


def test_what_is_imported_is_what_is_declared(imports: list[Import]) -> None:
    assert {item.library for item in imports} - set(sys.stdlib_module_names) - set(PACKAGES) == declared() - {
        "pandas"
    }  # pyarrow does


def test_help_loads_no_library() -> None:
    loaded = loaded_by("import scenarios.cli\ntry: scenarios.cli.main(['--help'])\nexcept SystemExit: pass")
    assert "scenarios" in loaded
    assert not loaded & declared()


def test_the_list_loads_neither_the_simulator_nor_what_checks_scenarios() -> None:
    loaded = loaded_by("import scenarios.cli\nscenarios.cli.main(['list'])")
    assert not loaded & {"mujoco", "pydantic", "pyarrow", "pandas"}


REMOVING = {"unlink", "rmdir", "rmtree", "rename", "renames", "remove", "removedirs", "move"}
OUTPUTS = "quadsim.outputs"


def removals(source: str) -> list[str]:
    """Calls that remove or replace files, of `os`, `shutil` and `pathlib`; `text.replace` has two arguments."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
            continue
        name = node.func.attr
        if name != "replace" and name not in REMOVING:
            continue
        owner = ast.unparse(node.func.value)
        of_list = name == "remove" and owner not in ("os", "files", "self._files")
        replaces = name == "replace" and (len(node.args) == 1 or owner == "os") and owner != "dataclasses"
        if replaces or (name in REMOVING and not of_list):
            found.append(f"{owner}.{name}")
    return found


def test_one_module_alone_removes_and_replaces_files() -> None:
    assert removals("import os; os.replace(a, b); p.unlink(); p.replace(q); 'a'.replace('b', 'c'); l.remove(1)") == [
        "os.replace",
        "p.unlink",
        "p.replace",
    ]
    found = {name: removals(path.read_text()) for name, path in modules().items()}
    allowed = {"files.remove", "self._files.remove", "scenario.replace"}  # of `Growing`, and of a scenario's fields
    others = {name: calls for name, calls in found.items() if name != OUTPUTS}
    assert {name: calls for name, calls in others.items() if set(calls) - allowed} == {}
    trees = {name: calls.count("shutil.rmtree") for name, calls in found.items()}
    assert {name: count for name, count in trees.items() if count} == {OUTPUTS: 1}
