"""The numbers in the documents are today's."""

from __future__ import annotations

import re
from pathlib import Path
from pkgutil import resolve_name
from types import ModuleType

import matplotlib as mpl
import pytest

from scenarios.loading import load_scenario
from scenarios.run import fly_scenario

ROOT = Path(__file__).resolve().parent.parent
MADE = {"gallery.md"}
"""Pages that `make docs` makes."""
ENTRY_POINTS = {"quadsim.controllers"}
"""Groups of entry points, which are written like modules."""


def test_the_examples_in_the_page_on_effects_are_a_scenario(tmp_path: Path) -> None:
    page = (ROOT / "docs/effects.md").read_text(encoding="utf-8")
    example, mismatch, events = re.findall(r"```toml\n(.*?)```", page, flags=re.DOTALL)
    (tmp_path / "heavy-hover.toml").write_text(mismatch, encoding="utf-8")
    heavy = fly_scenario(load_scenario(str(tmp_path / "heavy-hover.toml")))
    assert heavy.state["z"][-1] - heavy.reference["z"][-1] == pytest.approx(-0.2, abs=0.01)
    (tmp_path / "gusty.toml").write_text(example + events, encoding="utf-8")
    scenario = load_scenario(str(tmp_path / "gusty.toml"), ["duration=16.0"])
    assert scenario.effects.air is not None
    assert [event.type for event in scenario.events] == ["gust", "push", "setpoint", "controller"]
    log = fly_scenario(scenario).log
    assert log.plant.wind is not None
    assert log.predicted is not None
    assert log.predicted.shape[1] == 30


def test_documents_link_to_files_that_exist() -> None:
    for document in [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]:
        for target in re.findall(r"\]\(([^)#]+)\)", document.read_text(encoding="utf-8")):
            if "://" not in target and target not in MADE:
                assert (document.parent / target).exists(), f"{document.name} links to {target}"


def test_pages_of_the_site_link_to_its_pages_alone() -> None:
    """What is in the repository and not on the site is named, not linked."""
    for document in (ROOT / "docs").glob("*.md"):
        assert "](../" not in document.read_text(encoding="utf-8"), document.name


def test_the_site_has_every_page() -> None:
    site = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    pages = {path.name for path in (ROOT / "docs").glob("*.md")} | MADE
    assert set(re.findall(r"[a-z-]+\.md", site)) == pages


@pytest.mark.usefixtures("campaigns_here")
@pytest.mark.parametrize("document", ["../README.md", *sorted(path.name for path in (ROOT / "docs").glob("*.md"))])
def test_python_on_the_pages_runs(document: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The blocks of a page in their order, as the notebook that it is too."""
    mpl.use("Agg")
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "docs" / document).read_text(encoding="utf-8")
    module = ModuleType("page")
    for block in re.findall(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
        exec(compile(block, document, "exec"), module.__dict__)


@pytest.mark.parametrize(
    "document", ["CONTRIBUTING.md", "README.md", *sorted(p.name for p in (ROOT / "docs").glob("*.md"))]
)
def test_documents_name_what_exists(document: str) -> None:
    """Every dotted name of a package in backticks is a module, or something in one."""
    page = next(path for path in (ROOT / document, ROOT / "docs" / document) if path.exists())
    named = set(re.findall(r"`((?:mpc|quadsim|scenarios)(?:\.[A-Za-z_]+)+)`", page.read_text(encoding="utf-8")))
    assert document != "equations.md" or len(named) > 40
    for name in sorted(named - ENTRY_POINTS):
        resolve_name(name)
