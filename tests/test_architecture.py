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
    f"quadsim.{name}" for name in ("vehicle", "state", "rotation", "errors", "fields", "controller", "motion", "space",
                                      "input_limits")
}  # fmt: skip
RENDER_WORKER = "quadsim.report.film.render_worker"
"""Only ever run as a child process, so it may import at its top what is heavy."""
RECORDING = re.compile(r"quadsim\.report\.recording\.(plots|world)")
"""Imported when a recording is made, and so may import rerun at their top."""
OF_ONE_PLACE = {
    "rerun": "quadsim.report.recording",
    "imageio": "quadsim.report.film",
    "imageio_ffmpeg": "quadsim.report.film",
    "jinja2": "quadsim.report.page",
    "matplotlib": "quadsim.report.to_matplotlib",
    "plotly": "quadsim.report.to_plotly",
    "distributed": "scenarios.many",
    "optuna": "scenarios.tuning",
    "gymnasium": "scenarios.gym",
    "pyulog": "scenarios.identify",
}
"""What only some outputs need, and where alone it is imported."""
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
    result = [item for name, path in ours.items() for item in imports_of(name, path.read_text(), set(ours))]
    assert {item.importer.partition(".")[0] for item in result} == set(PACKAGES)
    return result


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


def test_the_testbed_imports_nothing_of_ours(imports: list[Import]) -> None:
    """But for `import quadsim` and `import quadsim.gym`, which hand out what users call, late."""
    result = [i for i in imports if i.importer.startswith("quadsim") and i.library in {"mpc", "scenarios", "piqp"}]
    assert {i.importer for i in result} == {"quadsim", "quadsim.gym"}
    assert not [i for i in result if i.at_start]


def test_controllers_know_vehicle_state_errors_and_protocol_alone(imports: list[Import]) -> None:
    named = {i.imported for i in imports if i.importer.startswith("mpc")}
    assert {name for name in named if name.startswith(("quadsim", "scenarios"))} <= MPC_MAY_IMPORT
    assert "mujoco" not in {name.partition(".")[0] for name in named}


def test_controllers_run_without_a_simulator() -> None:
    optional = {"mpc.solvers.daqp": "daqp", "mpc.solvers.qpsolvers": "qpsolvers"}
    loaded = loaded_by("import " + ", ".join(name for name in set(modules()) - set(optional) if name.startswith("mpc")))
    assert {"mpc", "quadsim", "piqp"} <= loaded
    assert not loaded & {"mujoco", "scenarios", "pydantic", *OF_ONE_PLACE, *optional.values()}


@pytest.mark.parametrize("library", OF_ONE_PLACE)
def test_a_library_for_outputs_is_imported_in_one_place_and_late(library: str, imports: list[Import]) -> None:
    uses = [item for item in imports if item.library == library]
    assert uses
    assert not [item for item in uses if not f"{item.importer}.".startswith(f"{OF_ONE_PLACE[library]}.")]
    at_start = {item.importer for item in uses if item.at_start and library != "gymnasium"}
    assert not [name for name in at_start - {RENDER_WORKER} if not RECORDING.fullmatch(name)]


def test_what_records_is_imported_late(imports: list[Import]) -> None:
    uses = [item for item in imports if RECORDING.fullmatch(item.imported)]
    assert not [i for i in uses if i.at_start and not RECORDING.fullmatch(i.importer)]


def test_the_render_worker_is_imported_by_nobody(imports: list[Import]) -> None:
    assert RENDER_WORKER not in {item.imported for item in imports}


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


def test_what_is_imported_is_what_is_declared(imports: list[Import]) -> None:
    assert {item.library for item in imports} - set(sys.stdlib_module_names) - set(PACKAGES) == declared() - {
        "pandas"
    }  # pyarrow does


def test_help_loads_little_and_list_no_simulator() -> None:
    loaded = loaded_by("import scenarios.cli\nscenarios.cli.main(['--help'])")
    assert "scenarios" in loaded
    assert loaded & declared() == {"cyclopts", "rich"}
    loaded = loaded_by("import scenarios.cli\nscenarios.cli.main(['list'])")
    assert not loaded & {"mujoco", "pydantic", "pyarrow", "pandas"}


OF_CONTROLLERS = re.compile(r"(?:^|[._])(law|controller|pilot|guard|spec|inner|autopilot|previous|agent|successor)\w*$")
"""Names of what flies: controllers, their laws, guards and inner loops, and of their tables (`spec`)."""


def unwritten(source: str) -> Iterator[str]:
    """Attributes asked for by a literal name of what may lack them: an optional part of a protocol written nowhere.

    It counts `getattr` and `hasattr` on `OF_CONTROLLERS`.  Optional parts are protocols of `quadsim.controller` and its
    like in `mpc`, asked for by `isinstance`, and class attributes of `mpc.bounded.ControllerTable`.
    """
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call) and ast.unparse(node.func) in ("getattr", "hasattr"):
            owner, name = map(ast.unparse, node.args[:2])
            if isinstance(node.args[1], ast.Constant) and OF_CONTROLLERS.search(owner):
                yield f"{owner}.{ast.literal_eval(name)}"


def test_the_protocol_of_a_controller_is_written_down() -> None:
    asked = "getattr(self._law, 'trim', None)\nhasattr(spec, 'indi')\ngetattr(law, source)\ngetattr(force, 'reset')"
    assert [*unwritten(asked)] == ["self._law.trim", "spec.indi"]
    result = {name: [*unwritten(path.read_text())] for name, path in modules().items()}
    assert {name: asked for name, asked in result.items() if asked} == {}


REMOVING = {"unlink", "rmdir", "rmtree", "rename", "renames", "remove", "removedirs", "move"}
OUTPUTS = "quadsim.outputs"


def removals(source: str) -> Iterator[str]:
    """Calls that remove or replace files, of `os`, `shutil` and `pathlib`; `text.replace` has two arguments."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            name, owner = node.func.attr, ast.unparse(node.func.value)
            if name == "replace":
                removes = (len(node.args) == 1 or owner == "os") and owner not in ("dataclasses", "scenario")
            else:
                removes = name in REMOVING and (name != "remove" or owner == "os")
            if removes:
                yield f"{owner}.{name}"


def test_one_module_alone_removes_and_replaces_files() -> None:
    result = {name: [*removals(path.read_text())] for name, path in modules().items()}
    assert result.pop(OUTPUTS).count("shutil.rmtree") == 1
    assert result.pop("mpc.core.build") == ["partial.replace", "partial.unlink"]  # run without quadsim
    assert {name: calls for name, calls in result.items() if calls} == {}
