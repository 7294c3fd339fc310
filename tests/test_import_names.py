"""quadsim takes one import name: `mpc` and `scenarios` are free for a user's own files."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
USERS = (
    "from mpc import MPC\n"
    "import quadsim\n"
    "import mpc, scenarios\n"
    "print(mpc.MPC is MPC, scenarios.MPC.__name__)\n"
    "print(quadsim.mpc.__name__, hasattr(quadsim.mpc, 'LinearMPC'))\n"
    "print(quadsim.fly(quadsim.load('hover', {'duration': 0.1}), progress=False).outcome)\n"
)
MANY = (
    "mass = {'name': 'mass', 'fields': ['vehicle.mass'], 'distribution': 'uniform', 'low': 4.0, 'high': 4.1}\n"
    "hover = quadsim.load('hover', {'duration': 0.1})\n"
    "if __name__ == '__main__':\n"
    "    flown = quadsim.campaign(hover, vary=[mass], flights=2, workers=2, out='c', report=False, progress=False)\n"
    "    print(flown.table['verdict'].to_pylist())\n"
)


def run(script: str, here: Path) -> subprocess.CompletedProcess[str]:
    """Run a script of a folder, with the checkout on the path as an editable install has it."""
    (here / "script.py").write_text(script)
    environment = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "script.py"]
    return subprocess.run(command, cwd=here, env=environment, capture_output=True, text=True, check=False)


@pytest.fixture
def beside(tmp_path: Path) -> Path:
    """A folder with the user's own `mpc.py`, and a package `scenarios`."""
    (tmp_path / "scenarios").mkdir()
    for file in ("mpc.py", "scenarios/__init__.py"):
        (tmp_path / file).write_text("class MPC: pass\n")
    return tmp_path


def test_a_user_s_own_files_of_these_names_are_imported(beside: Path) -> None:
    done = run(USERS, beside)
    assert done.stdout.splitlines() == ["True MPC", "quadsim.mpc True", "satisfied"], done.stderr


@pytest.mark.slow("process")
def test_workers_of_a_campaign_do_without_them_too(beside: Path) -> None:
    done = run(f"import quadsim\n{MANY}", beside)
    assert done.stdout.splitlines() == ["['satisfied', 'satisfied']"], done.stderr


def test_importing_quadsim_changes_no_way_of_finding_modules(tmp_path: Path) -> None:
    done = run("import sys\nbefore = [*sys.meta_path]\nimport quadsim\nprint(sys.meta_path == before)\n", tmp_path)
    assert done.stdout == "True\n", done.stderr


def test_the_link_of_a_checkout_says_the_import_name(tmp_path: Path) -> None:
    (tmp_path / "mpc").symlink_to(ROOT / "quadsim" / "mpc")
    for statement in ("import mpc", "from mpc import Problem", "import mpc.ocp"):
        done = run(f"{statement}\n", tmp_path)
        assert done.returncode == 1
        assert done.stderr.splitlines()[-1] == (
            "ImportError: this is quadsim's package of controllers: import quadsim.mpc"
        )


def test_the_link_leads_to_the_controllers() -> None:
    """It is in a checkout alone, not in a source archive."""
    link = ROOT / "mpc"
    assert not link.is_symlink() or link.readlink() == Path("quadsim/mpc")
