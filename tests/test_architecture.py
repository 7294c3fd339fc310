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
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path
from typing import TypeGuard

import pytest

from quadsim.core.build import sources
from quadsim.features.entries import FEATURES

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("quadsim",)
PAGE = ROOT / "docs" / "architecture.md"
USERS_IMPORT = ("quadsim", "quadsim.__main__", "quadsim.gym")
MPC_MAY_IMPORT = {
    f"quadsim.{name}" for name in ("vehicle", "state", "rotation", "errors", "fields", "controller", "motion", "space",
                                      "ties", "input_limits",
                                      "shorthands", "core.mirror", "core.structs", "core.inner")
}  # fmt: skip
RENDER_WORKER = "quadsim.report.film.render_worker"
"""Only ever run as a child process, so it may import at its top what is heavy."""
RECORDING = re.compile(r"quadsim\.report\.recording\.(plots|world)")
"""Imported when a recording is made, and so may import rerun at their top."""
LOGS = ("orangebox", "pymavlink", "pyulog", "rosbags")
"""Libraries that read logs."""
OF_ONE_PLACE = {
    "rerun": "quadsim.report.recording",
    "imageio": "quadsim.report.film",
    "imageio_ffmpeg": "quadsim.report.film",
    "jinja2": "quadsim.report.page",
    "matplotlib": "quadsim.report.to_matplotlib",
    "plotly": "quadsim.report.to_plotly",
    "distributed": "quadsim.rollout.many",
    "gymnasium": "quadsim.features.gym",
    **dict.fromkeys(LOGS, "quadsim.features.identify"),
}
"""What only some outputs need, and where alone it is imported."""
OF_FEATURES = {
    "gymnasium": "gym",
    **dict.fromkeys(LOGS, "identify"),
    **dict.fromkeys(("trimesh", "viser", "websockets"), "live"),
}
ABSENT = {library for library, feature in OF_FEATURES.items() if feature not in FEATURES}
"""Libraries that a feature alone uses, and those of features that have been taken away."""
IMPORT_NAMES = {"pillow": "PIL", "rerun-sdk": "rerun"}
"""Distributions whose import name is not their own."""
HANDING_OUT = ("quadsim", "quadsim.mpc", "quadsim.gym")
"""Modules with a table of public names, each imported on first use; `quadsim` also starts the command."""
DEFINED_TWICE = {"export", "fly", "load_vehicle", "main"}
"""Public names that two modules define: a function and its command, or a command line and its process (`main`)."""
FORMULAS_TWICE = {("quadsim_nonlinear.c", "quadsim_rotation.h")}
"""C files that share a formula: the angles of a quaternion, as a controller is exported without the plant's headers."""


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


@cache
def parsed(source: str) -> ast.Module:
    """A module's tree, which several tests walk."""
    return ast.parse(source)


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

    yield from visit(parsed(source), True)


@pytest.fixture(scope="module")
def imports() -> list[Import]:
    ours = modules()
    result = [item for name, path in ours.items() for item in imports_of(name, path.read_text(), set(ours))]
    assert {item.importer.partition(".")[0] for item in result} == set(PACKAGES)
    return result


def loaded_by(code: str) -> set[str]:
    """Top-level names of all modules that a fresh interpreter has loaded after some code; two levels of ours."""
    report = "import sys\nprint(*sys.modules, file=sys.stderr)"
    command = [sys.executable, "-c", f"{code}\n{report}"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    names = [name.split(".") for name in done.stderr.split()]
    return {name[0] for name in names} | {".".join(name[:2]) for name in names if name[0] == "quadsim"}


def declared() -> set[str]:
    """Import names of the run-time dependencies in pyproject.toml, optional ones included."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    requirements = [*project["dependencies"], *itertools.chain(*project["optional-dependencies"].values())]
    names = [re.split(r"[<>=!~\[; ]", requirement, maxsplit=1)[0] for requirement in requirements]
    return {IMPORT_NAMES.get(name, name.replace("-", "_")) for name in names}


def floors() -> list[str]:
    """The folders in the table of floors of docs/architecture.md, from the lowest on."""
    table = PAGE.read_text(encoding="utf-8").partition("## Floors")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| `([\w.]+)/?`.* \|.*\|$", table, re.MULTILINE)
    assert rows[0] == "__init__.py"
    return rows[:0:-1]


def floor_of(module: str) -> int:
    """The height of a module: 0 of `core` and of what is in no folder, the highest of what users import."""
    heights = floors()
    if module in USERS_IMPORT:
        return len(heights)
    folder = module.split(".")[1]
    if folder in heights:
        return heights.index(folder)
    assert (ROOT / "quadsim" / f"{folder}.py").is_file(), f"{PAGE.name} has no floor for quadsim/{folder}"
    return 0


def upwards(imports: list[Import]) -> list[str]:
    """Imports of what is on a higher floor, in functions and for typing too."""
    ours = modules()
    heights = {name: floor_of(name) for name in ours}
    return [
        f"{item.importer} imports {item.imported}"
        for item in imports
        if item.imported in ours and heights[item.importer] < heights[item.imported]
    ]


def test_every_floor_imports_those_below_alone(imports: list[Import]) -> None:
    assert {floor_of(name) for name in modules()} == {*range(len(floors()) + 1)}
    assert upwards(imports) == []


def test_an_import_of_a_higher_floor_is_seen_even_if_it_is_late_or_for_types_alone() -> None:
    source = "if TYPE_CHECKING:\n    from quadsim.sim.plant import Plant\ndef f():\n    from quadsim.mpc import ocp"
    found = [*imports_of("quadsim.mpc.problem.qp", source, {*modules()})]
    assert upwards(found) == ["quadsim.mpc.problem.qp imports quadsim.sim.plant"]
    assert upwards([*imports_of("quadsim.state", "import quadsim", {*modules()})]) == ["quadsim.state imports quadsim"]


def within_mpc() -> list[str]:
    """The parts of `quadsim/mpc` in the list of docs/architecture.md, from the lowest on."""
    listed = PAGE.read_text(encoding="utf-8").partition("Inside `mpc/`")[2].partition("No modules import")[0]
    return re.findall(r"^- `(\w+)(?:/|\.py)`:", listed, re.MULTILINE)


def test_every_part_of_mpc_imports_those_before_it_in_the_list(imports: list[Import]) -> None:
    parts = within_mpc()
    inside = re.compile(r"quadsim\.mpc\.(\w+)")
    upward = []
    for item in imports:
        importer = inside.match(item.importer)
        imported = inside.match(item.imported)
        if importer and imported and parts.index(importer[1]) < parts.index(imported[1]):
            upward.append(f"{item.importer} imports {item.imported}")
    of_python = {*parts} - {"c"}
    if "export" not in FEATURES:
        of_python -= {"export"}
    assert of_python == {match[1] for match in map(inside.match, modules()) if match}
    assert upward == []


def test_controllers_know_vehicle_state_errors_and_protocol_alone(imports: list[Import]) -> None:
    of_controllers = [item for item in imports if f"{item.importer}.".startswith("quadsim.mpc.")]
    others = {item.imported for item in of_controllers if item.library == "quadsim"}
    assert {name for name in others if not name.startswith("quadsim.mpc")} <= MPC_MAY_IMPORT
    assert "mujoco" not in {item.library for item in of_controllers}


def test_controllers_run_without_a_simulator() -> None:
    optional = {"quadsim.mpc.solvers.daqp": "daqp", "quadsim.mpc.solvers.qpsolvers": "qpsolvers"}
    controllers = [name for name in modules() if name.startswith("quadsim.mpc") and name not in optional]
    loaded = loaded_by(f"import {', '.join(controllers)}")
    above = {f"quadsim.{folder}" for folder in floors()[floors().index("mpc") + 1 :]}
    assert {"quadsim.mpc", "quadsim", "piqp"} <= loaded
    assert not loaded & {"mujoco", "pydantic", *above, *OF_ONE_PLACE, *optional.values()}


@pytest.mark.parametrize("library", OF_ONE_PLACE)
def test_a_library_for_outputs_is_imported_in_one_place_and_late(library: str, imports: list[Import]) -> None:
    uses = [item for item in imports if item.library == library]
    assert uses or library in ABSENT
    for item in uses:
        assert f"{item.importer}.".startswith(f"{OF_ONE_PLACE[library]}."), item
        may_be_early = item.importer == RENDER_WORKER or RECORDING.fullmatch(item.importer) or library == "gymnasium"
        assert may_be_early or not item.at_start, item


def test_what_records_is_imported_late(imports: list[Import]) -> None:
    for item in imports:
        if RECORDING.fullmatch(item.imported) and not RECORDING.fullmatch(item.importer):
            assert not item.at_start, item


def test_the_render_worker_is_imported_by_nobody(imports: list[Import]) -> None:
    assert RENDER_WORKER not in {item.imported for item in imports}


def test_no_module_and_no_folder_imports_what_imports_it(imports: list[Import]) -> None:
    ours = modules()
    packages = {name.rpartition(".")[0] for name in ours}
    for package in packages:
        within = f"{package}." if package else ""

        def child(name: str, within: str = within) -> str:
            """The module or folder of the package that has a module."""
            return name.removeprefix(within).partition(".")[0]

        graph: dict[str, set[str]] = {}
        for item in imports:
            inside = item.importer.startswith(within) and item.imported.startswith(within)
            if item.at_start and item.imported in ours and inside and child(item.imported) != child(item.importer):
                graph.setdefault(child(item.importer), set()).add(child(item.imported))
        tuple(TopologicalSorter(graph).static_order())  # raises where there is a cycle


def circles(imports: list[Import]) -> list[list[str]]:
    """Groups of modules that import one another, directly or through others, whether at start, late or for types.

    What hands out public names (`HANDING_OUT`) counts as any module; that importing a module runs its packages does
    not.
    """
    ours = modules()
    graph: dict[str, set[str]] = {}
    for item in imports:
        if item.imported in ours and item.imported != item.importer:
            graph.setdefault(item.importer, set()).add(item.imported)

    def reached(start: str) -> set[str]:
        """The modules that a module imports, directly or through others."""
        found: set[str] = set()
        to_visit = [start]
        while to_visit:
            new = graph.get(to_visit.pop(), set()) - found
            found |= new
            to_visit += new
        return found

    reach = {name: reached(name) for name in graph}
    groups = set()
    for name in graph:
        group = sorted(other for other in reach[name] if name in reach.get(other, ()))
        if group:
            groups.add(tuple(group))
    return [[*group] for group in sorted(groups)]


def test_a_circle_is_seen_even_if_it_closes_late_or_for_types_alone() -> None:
    sources = {
        "quadsim.mpc.problem.qp": "if TYPE_CHECKING:\n    from quadsim.mpc.problem.paper import Prediction",
        "quadsim.mpc.problem.paper": "def cost():\n    from quadsim.mpc.problem import ocp",
        "quadsim.mpc.problem.ocp": "import quadsim.mpc.problem.qp\nimport quadsim.mpc.problem.model",
        "quadsim.mpc.problem.model": "import quadsim.mpc.problem.model",
    }
    ours = {*modules()}
    found = [item for name, source in sources.items() for item in imports_of(name, source, ours)]
    assert circles(found) == [["quadsim.mpc.problem.ocp", "quadsim.mpc.problem.paper", "quadsim.mpc.problem.qp"]]


def test_no_modules_import_in_a_circle(imports: list[Import]) -> None:
    assert circles(imports) == []


def test_what_hands_out_public_names_is_part_of_a_circle_if_a_module_below_imports_it() -> None:
    sources = {"quadsim": "def f():\n    from quadsim.vehicle import Vehicle", "quadsim.vehicle": "import quadsim"}
    ours = {*modules()}
    found = [item for name, source in sources.items() for item in imports_of(name, source, ours)]
    assert circles(found) == [["quadsim", "quadsim.vehicle"]]


def test_nothing_imports_what_hands_out_public_names(imports: list[Import]) -> None:
    """But one of these another: `quadsim.mpc` is one of the names that `quadsim` has."""
    users = {item.importer for item in imports if item.imported in HANDING_OUT}
    assert users - {*HANDING_OUT} == set()


def public_names(source: str) -> set[str]:
    """What a module defines at its top level, under an `if` too: classes, functions, constants and names of types.

    Private names do not count, nor does what stands for an imported class where it is not needed (`Flight = Any`).
    """

    def names(body: list[ast.stmt]) -> Iterator[str]:
        for node in body:
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                yield node.name
            elif isinstance(node, ast.Assign) and ast.unparse(node.value) != "Any":
                yield from (leaf.id for target in node.targets for leaf in ast.walk(target) if named(leaf))
            elif isinstance(node, ast.AnnAssign) and named(node.target):
                yield node.target.id
            elif isinstance(node, ast.If | ast.Try):
                yield from names([*node.body, *node.orelse])

    def named(node: ast.AST) -> TypeGuard[ast.Name]:
        return isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)

    return {name for name in names(parsed(source).body) if not name.startswith("_")}


def test_a_public_name_is_one_that_a_module_defines() -> None:
    source = """
import a
_B = 1
C: int = 2
d[0] = 3
E = F = Any
if a:
    G, H = 4, 5
def i(): j = 6
class K: l = 7
"""
    assert public_names(source) == {"C", "G", "H", "i", "K"}


def test_no_other_public_names_are_defined_twice() -> None:
    places: dict[str, list[str]] = {}
    for module, path in modules().items():
        for name in public_names(path.read_text()):
            places.setdefault(name, []).append(module)
    twice = {name: sorted(definers) for name, definers in places.items() if len(definers) > 1}
    assert {name: definers for name, definers in twice.items() if name not in DEFINED_TWICE} == {}


def formulas(source: str) -> Iterator[tuple[str, ...]]:
    """Yield long expressions that C code assigns, of three products or more, with names by order of appearance."""
    source = re.sub(r"/\*.*?\*/|^\s*#.*?$", "", source, flags=re.DOTALL | re.MULTILINE)
    source = re.sub(r"\bR\((-?[\d.e+-]+)\)", r"\1", source)
    for statement in re.split(r"[;{}]", source):
        _, _, assigned = statement.partition("=")
        names: dict[str, str] = {}
        words = re.findall(r"[A-Za-z_]\w*|[\d.]+(?:e[+-]?\d+)?|->|[^\s\w]", assigned)
        if len(words) > 16 and words.count("*") > 2:
            yield tuple(names.setdefault(word, f"name{len(names)}") if word[0].isalpha() else word for word in words)


def test_a_formula_is_found_whatever_its_names_are() -> None:
    one = "real a = R(2.0) * (q[1] * q[3] + q[0] * q[2]);"
    other = "/* = */ x->b += 2.0 * (w[1] * w[3] + w[0] * w[2]);"
    assert [*formulas(one)] == [*formulas(other)] != []
    assert [*formulas(one.replace("q[0]", "p[0]"))] != [*formulas(other)]


def test_the_rigid_body_is_written_once_in_c() -> None:
    places: dict[tuple[str, ...], set[str]] = {}
    for path in sources():
        for formula in formulas(path.read_text()):
            places.setdefault(formula, set()).add(path.name)
    for formula, files in places.items():
        assert len(files) == 1 or tuple(sorted(files)) in FORMULAS_TWICE, f"{sorted(files)}: {' '.join(formula)}"


def test_c_of_the_testbed_includes_its_own_headers_alone() -> None:
    core = ROOT / "quadsim" / "core"
    included = {name for path in core.glob("*.[ch]") for name in re.findall(r'#include "(.*)"', path.read_text())}
    assert included == {path.name for path in core.glob("*.h")}


def test_what_is_imported_is_what_is_declared(imports: list[Import]) -> None:
    imported = {item.library for item in imports} - set(sys.stdlib_module_names) - set(PACKAGES)
    assert imported | ABSENT == declared()


def test_help_loads_little_and_list_no_simulator() -> None:
    loaded = loaded_by("import quadsim.commands.cli\nquadsim.commands.cli.main(['--help'])")
    assert "quadsim.commands" in loaded
    assert loaded & declared() == {"cyclopts", "rich"}
    loaded = loaded_by("import quadsim.commands.cli\nquadsim.commands.cli.main(['list'])")
    assert not loaded & {"mujoco", "pydantic", "pyarrow", "pandas"}


OF_CONTROLLERS = re.compile(r"(?:^|[._])(law|controller|pilot|guard|spec|inner|autopilot|previous|agent|successor)\w*$")
"""Names of what flies: controllers, their laws, guards and inner loops, and of their tables (`spec`)."""


def unwritten(source: str) -> Iterator[str]:
    """Attributes asked for by a literal name of what may lack them: an optional part of a protocol written nowhere.

    It counts `getattr` and `hasattr` on `OF_CONTROLLERS`.  Optional parts are protocols of `quadsim.controller` and its
    like in `mpc`, asked for by `isinstance`, and class attributes of `quadsim.mpc.tables.controller.ControllerTable`.
    """
    for node in ast.walk(parsed(source)):
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
    for node in ast.walk(parsed(source)):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            name = node.func.attr
            owner = ast.unparse(node.func.value)
            if name == "replace":
                removes = (len(node.args) == 1 or owner == "os") and owner not in ("dataclasses", "scenario")
            else:
                removes = name in REMOVING and (name != "remove" or owner == "os")
            if removes:
                yield f"{owner}.{name}"


def test_one_module_alone_removes_and_replaces_files() -> None:
    result = {name: [*removals(path.read_text())] for name, path in modules().items()}
    assert result.pop(OUTPUTS).count("shutil.rmtree") == 1
    assert result.pop("quadsim.core.build") == ["partial.replace"]  # run without quadsim
    assert {name: calls for name, calls in result.items() if calls} == {}
