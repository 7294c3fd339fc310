"""A user's files, or packages, called `mpc` or `scenarios` do not stand in for quadsim's own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FLY = "import quadsim\nprint(quadsim.fly(quadsim.load('hover', {'duration': 0.1}), progress=False).outcome)\n"
MANY = (
    "mass = {'name': 'mass', 'fields': ['vehicle.mass'], 'distribution': 'uniform', 'low': 4.0, 'high': 4.1}\n"
    "hover = quadsim.load('hover', {'duration': 0.1})\n"
    "if __name__ == '__main__':\n"
    "    flown = quadsim.campaign(hover, vary=[mass], flights=2, workers=2, out='c', report=False, progress=False)\n"
    "    print(flown.table['verdict'].to_pylist())\n"
)


def run(script: str, here: Path) -> subprocess.CompletedProcess[str]:
    (here / "script.py").write_text(script)
    environment = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "script.py"]
    return subprocess.run(command, cwd=here, env=environment, capture_output=True, text=True, check=False)


@pytest.fixture
def beside(tmp_path: Path) -> Path:
    """A folder with the user's own `mpc.py`, and a package `scenarios`; both note that they were executed."""
    (tmp_path / "scenarios").mkdir()
    for file in ("mpc.py", "scenarios/__init__.py"):
        (tmp_path / file).write_text("open('executed', 'a').write(__name__)\nclass MPC: pass\n")
    return tmp_path


@pytest.mark.slow("process")
def test_files_of_these_names_beside_a_script_are_not_imported_in_their_place(beside: Path) -> None:
    done = run(FLY + MANY, beside)
    assert done.stdout.splitlines() == ["satisfied", "['satisfied', 'satisfied']"], done.stderr
    assert not (beside / "executed").exists()


@pytest.mark.parametrize(("name", "file"), [("mpc", "mpc.py"), ("scenarios", "scenarios/__init__.py")])
def test_one_that_was_imported_before_is_named_with_what_to_do(beside: Path, name: str, file: str) -> None:
    done = run(f"from {name} import MPC\n{FLY}", beside)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.splitlines()[-1] == (
        f"ImportError: quadsim has a package {name!r}, and {beside / file} was imported under that name before: rename "
        "that file, or import quadsim first and do without it"
    )


def test_quadsim_s_own_may_be_imported_first(tmp_path: Path) -> None:
    done = run(
        "import mpc, scenarios.commands.entry\nfirst = mpc\nimport quadsim, mpc\nprint(mpc is first)\n", tmp_path
    )
    assert done.stdout == "True\n", done.stderr
