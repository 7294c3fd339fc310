"""The wheel is complete: installed alone and outside the checkout it flies.  Pins and version numbers agree."""

from __future__ import annotations

import itertools
import json
import os
import re
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest

from quadsim import __version__
from quadsim.core.build import LIBRARY, platform_tag, requirements

pytestmark = pytest.mark.slow("packages")

ROOT = Path(__file__).resolve().parent.parent
DATA = (
    "*.py",
    "py.typed",
    "*.toml",
    "*.csv",
    "*.xml",
    "*.j2",
    "*.css",
    "*.js",
    "mpc/c/*",
    "export/c/*",
    "core/*.[ch]",
)


@pytest.fixture(scope="module")
def dist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With the source archive, and the wheel built from that archive, not from the checkout."""
    directory = tmp_path_factory.mktemp("dist")
    command: list[str | Path] = [sys.executable, "-m", "build", "--outdir", directory, ROOT]
    if not requirements():  # no compiler has to be fetched
        command.append("--no-isolation")
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return directory


@pytest.fixture(scope="module")
def installed(dist: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`bin` of an environment with the wheel in it, and of this one's packages all but the checkout.

    The packages come from a path file, which is read without the path files beside them: no editable install follows.
    """
    home = tmp_path_factory.mktemp("environment")
    venv.create(home)
    python = home / "bin" / "python"
    command: list[str | Path] = [sys.executable, "-m", "pip", "--python", python, "install", "--no-index", "--no-deps"]
    subprocess.run([*command, *dist.glob("*.whl")], check=True, capture_output=True)
    (site,) = home.glob("lib/python*/site-packages")
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return home / "bin"


def run_alone(command: list[str | Path], directory: Path) -> str:
    """Standard output of a command in a directory, with nothing that leads back to the checkout."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run(command, cwd=directory, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_wheel_holds_every_file_of_the_packages(dist: Path) -> None:
    files = {path for pattern in DATA for path in (ROOT / "quadsim").rglob(pattern)}
    expected = {path.relative_to(ROOT).as_posix() for path in files}
    expected |= {f"quadsim/models/{path.name}" for path in (ROOT / "models").iterdir()} | {LIBRARY}
    library = [path for path in (ROOT / "scenarios").rglob("*") if path.suffix in (".toml", ".csv")]
    expected |= {f"quadsim/library/{path.relative_to(ROOT / 'scenarios').as_posix()}" for path in library}
    (file,) = dist.glob("*.whl")
    with zipfile.ZipFile(file) as wheel:
        held = {name for name in wheel.namelist() if ".dist-info/" not in name}
    assert held == expected
    assert {"quadsim/models/quadrotor.xml", "quadsim/py.typed", "quadsim/library/flights/hover.toml"} <= held
    assert {name.partition("/")[0] for name in held} == {"quadsim"}, "one name"
    assert "quadsim/library/variants.toml" in held
    assert any(name.startswith("quadsim/report/templates/") for name in held)


def test_source_archive_can_be_built_and_tested_from(dist: Path) -> None:
    (file,) = dist.glob("*.tar.gz")
    with tarfile.open(file) as sdist:
        held = {name.partition("/")[2] for name in sdist.getnames()}
    assert {"Makefile", "constraints.txt", "README.md", "LICENSE", "CITATION.cff", "tests/conftest.py"} <= held
    assert {".ci/run", "tests/peers/conftest.py", "docs/tools/remake.py", "docs/evidence.md"} <= held
    assert not [name for name in held if "__pycache__" in name or name.startswith(("runs/", ".venv/"))]


def test_wheel_flies_alone(installed: Path, tmp_path: Path) -> None:
    """The command lists; one process, which imports everything once, flies and compares."""
    assert "paper-constrained" in run_alone([installed / "quadsim", "list"], tmp_path)

    flight = ["run", "hover", "--set", "duration=1.0", "--no-video", "--no-recording", "--no-figures"]
    comparison = ["compare", "runs/hover", "--out", "page"]
    code = (
        "import sys, quadsim.mpc; from quadsim.commands.cli import main; "
        "print(quadsim.__file__, quadsim.mpc.__file__); "
        f"sys.exit(main({flight}) or main({comparison}))"
    )
    result = run_alone([installed / "python", "-c", code], tmp_path).partition("\n")[0].split()
    assert len(result) == 2
    assert all(Path(place).is_relative_to(installed.parent) for place in result), result
    summary = json.loads((tmp_path / "runs" / "hover" / "summary.json").read_text())
    assert summary["status"] == "completed"
    assert summary["satisfied"]
    assert (tmp_path / "runs" / "hover" / "flight.parquet").is_file()
    assert (tmp_path / "page" / "index.html").is_file()


def test_version_is_the_same_everywhere(dist: Path) -> None:
    printed = subprocess.run(
        [sys.executable, "-m", "quadsim.commands.entry", "--version"], cwd=ROOT, capture_output=True, text=True
    )
    changes = re.search(r"^## \[(.+?)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    citation = re.search(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert changes is not None
    assert citation is not None
    assert printed.stdout.strip() == f"quadsim {__version__}"
    assert [file.name for file in dist.glob("*.whl")] == [f"quadsim-{__version__}-py3-none-{platform_tag()}.whl"]
    assert (changes[1], citation[1]) == (__version__, __version__)


@pytest.mark.representative("packages")
def test_every_requirement_is_pinned() -> None:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = [line for line in lines if not line.startswith("#")]
    assert [pin for pin in pins if not re.fullmatch(r"[\w.-]+==\w[\w.]*", pin)] == []
    pyproject = tomllib.loads((ROOT / "pyproject.toml").read_text())
    project = pyproject["project"]
    groups = pyproject["dependency-groups"]
    required = itertools.chain(project["dependencies"], *project["optional-dependencies"].values(), *groups.values())
    open_ended = (requirement for requirement in required if "==" not in requirement)
    names = {plain(re.split(r"[<>=[]", requirement, maxsplit=1)[0]) for requirement in open_ended}
    assert names - {plain(pin.partition("==")[0]) for pin in pins} == set()


def plain(name: str) -> str:
    """A distribution's name as indexes compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()
