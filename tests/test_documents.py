"""The documents: golden numbers, links, and examples that run."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import tomllib
from collections.abc import Callable
from html import escape
from pathlib import Path
from pkgutil import resolve_name
from types import ModuleType

import built
import drawings
import gallery
import library
import matplotlib as mpl
import notebook
import pytest
import remake
import site_search
from _pytest.mark.structures import ParameterSet
from golden_numbers import ABLATION, PAPER, ablation_entry, paper_entry, read

from quadsim.rollout.flown import Flight
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.catalogue import scenario_names, variants
from quadsim.scenarios.loading import load_scenario

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCKS = re.compile(r"^```python(?: exec)?\n(.*?)^```", re.DOTALL | re.MULTILINE)
PYTHON = {page: blocks for page in PAGES if (blocks := BLOCKS.findall(page.read_text(encoding="utf-8")))}
"""Pages with examples in Python."""
SOURCES = [path for folder in ("quadsim", "benchmarks", "examples") for path in (ROOT / folder).rglob("*.py")]
RUN_ON = re.compile(r"^ *(?:Args|Attributes|Examples|Raises|Returns|Yields):[ ]*\S", re.MULTILINE)
"""A section of a docstring that starts on the line of its title, which no tool then takes for a section."""
SLOW = pytest.mark.slow("pages")
REPRESENTATIVE = pytest.mark.representative("pages")
ENTRY_POINTS = {"quadsim.controllers"}
"""Groups of entry points, which are written like modules."""


@pytest.mark.parametrize("name", PAPER)
def test_the_papers_flights_give_their_golden_numbers(name: str, fly_once: Callable[..., Flight]) -> None:
    """Of errors [m, deg], margins [deg, rad/s] and seconds; counts are exact."""
    result = paper_entry(fly_once(name))
    golden = read("paper")[name]
    assert result["rmse"] == pytest.approx(golden["rmse"], abs=1e-3)
    assert result["final_error"] == pytest.approx(golden["final_error"], abs=1e-5)
    for bound, numbers in golden["bounds"].items():
        assert result["bounds"][bound]["satisfied"] == numbers["satisfied"]
        assert result["bounds"][bound] == pytest.approx(numbers, abs=0.01), bound
    for key in ("highest_speed", "largest_step", "total_variation"):
        assert result[key] == pytest.approx(golden[key], rel=1e-3), key
    assert (result["optima"], result["periods"]) == (golden["optima"], golden["periods"])


@pytest.mark.parametrize("document", ["README.md", "docs/index.md"])
def test_a_page_shows_what_a_first_flight_prints(document: str, fly_once: Callable[..., Flight]) -> None:
    """The audit follows the command: its lines, as the flight prints them."""
    text = (ROOT / document).read_text(encoding="utf-8")
    (block,) = re.findall(r"```text\n(.*?)```", text, re.DOTALL)
    assert " pitch [deg] " in block
    printed = [line.rstrip() for line in fly_once("paper-constrained").text().splitlines()]
    assert not [line for line in block.splitlines() if line not in printed]


def test_the_first_picture_says_how_its_flights_differ_and_by_how_much() -> None:
    """In its own line: two controllers of different weights and horizons are no fair pair."""
    golden = read("paper")
    for page in (ROOT / "README.md", ROOT / "docs/index.md"):
        (line,) = re.findall(r"^.*flight\.gif.*$", page.read_text(encoding="utf-8"), re.MULTILINE)
        assert "differ in weights and horizon" in line, page.name
    caption = (ROOT / "README.md").read_text(encoding="utf-8").partition("flight.gif)")[2].strip().splitlines()[0]
    assert "differ in weights and horizon" in caption
    free, bounded = (golden[name]["bounds"] for name in ("paper-unconstrained", "paper-constrained"))
    for margin in (f"{free['pitch']['margin']:.2f} deg", f"{free['speed']['margin']:.2f} rad/s"):
        assert margin in caption
    assert f"{-bounded['pitch']['margin']:.3f} deg beyond its bound" in caption


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_page_as_built_repeats_no_block(page: Path) -> None:
    """A command shown again in place of its output; `make docs` reads the built site by the same rule."""
    text = page.read_text(encoding="utf-8")
    blocks = re.findall(r"^```\w*[^\n]*\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
    whole = "".join(f'<pre class="x"><code><span>{escape(block)}</span></code></pre>' for block in blocks)
    assert list(built.mistakes(text, whole)) == []
    if blocks:
        first = blocks[0].strip().splitlines()[0]
        again = f"<pre>{escape(blocks[0])}</pre>" + whole
        assert list(built.mistakes(text, again)) == [f"a block is shown again in place of what should follow: {first}"]
        assert f"a block is missing: {first}" in list(built.mistakes(text, ""))


def test_the_sites_search_corrects_long_words_alone_and_is_changed_once() -> None:
    """Of the script's line that takes a word within two edits; another script is refused."""
    line = 'p=e(t.terms[c],r);typeof p<"u"&&l.add(c,(h-p)/h)'
    changed = site_search.limited(f"before;{line};after")
    assert changed == 'before;p=e(t.terms[c],r);typeof p<"u"&&p<=(r.length<5?0:r.length<8?1:2)&&l.add(c,(h-p)/h);after'
    for other in (changed, f"{line};{line}", "none"):
        with pytest.raises(ValueError, match="must compare words in one place"):
            site_search.limited(other)


@pytest.mark.slow("pages")
@pytest.mark.parametrize("constraints", ABLATION)
def test_constraints_one_by_one_give_their_golden_numbers(constraints: str) -> None:
    result = ablation_entry(constraints)
    golden = read("ablation")[constraints]
    assert result["lost"] == golden["lost"]
    assert result["rmse"] == pytest.approx(golden["rmse"], abs=1e-3)


@pytest.mark.parametrize("document", ["README.md", "docs/paper.md"])
def test_tables_of_golden_numbers_are_filled(document: str) -> None:
    text = (ROOT / document).read_text(encoding="utf-8")
    assert "from tests/golden/" in text
    assert remake.filled(text)[0] == text, f"{document} is out of date: make numbers"


def test_every_scenario_in_the_library_opens_a_text_and_has_a_drawing() -> None:
    texts = gallery.texts()
    page = library.html()
    assert library.PLACE in (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
    assert set(re.findall(r"scenarios/([\w-]+)\.txt", page)) == {*texts} == {*scenario_names()}
    for file in re.findall(r'(?:src|poster)="(assets/[^"]+)"', page):
        assert (ROOT / "docs" / file).is_file(), file
    for name, row in variants().items():
        assert tomllib.loads(texts[name]) == {name: vars(row)}


def test_every_table_that_is_filled_is_known_and_stays_where_its_file_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    blocks = [block for page in PAGES for block in remake.BLOCK.findall(page.read_text(encoding="utf-8"))]
    opened = sum(page.read_text(encoding="utf-8").count("filled by docs/tools/remake.py from") for page in PAGES)
    assert len(blocks) == opened
    assert {name for name, _, _ in blocks} == set(remake.TABLES)
    monkeypatch.setattr(remake, "ROOT", tmp_path)
    monkeypatch.setattr(remake, "MADE", tmp_path)
    page = "before\n<!-- solvers: filled by docs/tools/remake.py from made.json -->\nold\n<!-- solvers end -->\nafter\n"
    assert remake.filled(page) == (page, ["made.json"])
    rows = [
        {"scenario": "hover", "solver": solver, "p99_ms": p99} for solver, p99 in (("piqp", 0.12345), ("osqp", 12.0))
    ]
    (tmp_path / "made.json").write_text(json.dumps({"machine": "fast", "records": rows}))
    text, missing = remake.filled(page)
    assert missing == []
    assert "| solver | `hover`, p99 [ms] |\n| --- | --- |\n| piqp | 0.123 |\n| osqp | 12 |\n" in text
    assert (text[:7], text[-7:]) == ("before\n", "\nafter\n")
    made = {"commit": "0123abcd", "date": "2026-01-02", "solver": "PIQP 1.2.3"}
    (tmp_path / "solvers.origin.json").write_text(json.dumps(made))
    stated = "*`make numbers OPTIONS=solvers`, commit 0123abcd, 2026-01-02, PIQP 1.2.3.*"
    assert stated in remake.filled(page)[0]


def test_numbers_are_made_by_their_command_with_their_origin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ran = []

    def run(command: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        ran.append(command)
        return subprocess.CompletedProcess(command, 0, stdout="0123abcd\n")

    monkeypatch.setattr(subprocess, "run", run)
    monkeypatch.setattr(remake, "MADE", tmp_path)
    remake.make("solvers")
    assert ran[0] == remake.COMMANDS["solvers"][0]
    assert json.loads((tmp_path / "solvers.origin.json").read_text(encoding="utf-8"))["commit"] == "0123abcd"


@pytest.mark.slow("pages")
def test_the_examples_in_the_page_on_effects_are_a_scenario(tmp_path: Path) -> None:
    page = (ROOT / "docs/effects.md").read_text(encoding="utf-8")
    example, mismatch, battery, events = re.findall(r"```toml\n(.*?)```", page, flags=re.DOTALL)
    (tmp_path / "heavy-hover.toml").write_text(mismatch, encoding="utf-8")
    heavy = Rollout(load_scenario(str(tmp_path / "heavy-hover.toml"))).fly()
    assert heavy.state["z"][-1] - heavy.reference["z"][-1] == pytest.approx(-0.2, abs=0.01)
    (tmp_path / "gusty.toml").write_text(example + battery + events, encoding="utf-8")
    scenario = load_scenario(str(tmp_path / "gusty.toml"), ["duration=16.0"])
    assert scenario.effects.air is not None
    assert [event.type for event in scenario.events] == ["gust", "push", "setpoint", "controller"]
    log = Rollout(scenario).fly().log
    assert log.plant.wind is not None
    assert log.plant.battery is not None
    assert log.predicted is not None
    assert log.predicted.shape[1] == 30


def test_documents_link_to_files_that_exist_and_the_site_has_every_page() -> None:
    pages = [*(ROOT / "docs").glob("*.md")]
    for document in [*ROOT.glob("*.md"), *pages]:
        text = document.read_text(encoding="utf-8")
        for target in re.findall(r"\]\(([^)#]+)\)", text):
            if "://" not in target:
                assert (document.parent / target).exists(), f"{document.name} links to {target}"
        assert document not in pages or "](../" not in text, "what is in the repository alone is named, not linked"
    site = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    assert set(re.findall(r"[a-z-]+\.md", site)) == {path.name for path in pages}


def anchor(heading: str) -> str:
    """Return the anchor that GitHub gives a heading."""
    return re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-")


def test_links_within_contributing_lead_to_its_headings() -> None:
    """The site's own pages are checked where it is built."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    anchors = {anchor(heading) for heading in re.findall(r"^#+ (.+)$", text, re.MULTILINE)}
    assert {*re.findall(r"\]\(#([^)]+)\)", text)} <= anchors


def marked_page(page: Path) -> ParameterSet:
    """A page among the slow ones, of which `make test` runs the README."""
    marks = [SLOW, REPRESENTATIVE] if page.name == "README.md" else [SLOW]
    return pytest.param(page, id=page.name, marks=marks)


@pytest.mark.usefixtures("campaigns_here")
@pytest.mark.parametrize("page", [marked_page(page) for page in PYTHON])
def test_python_on_the_pages_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The blocks of a page in their order, as the notebook that it is too."""
    mpl.use("Agg")
    monkeypatch.chdir(tmp_path)
    module = ModuleType("page")
    for block in PYTHON[page]:
        exec(compile(block, page, "exec"), module.__dict__)


def test_the_notebook_is_the_tutorial_whose_blocks_run() -> None:
    """Its cells are the blocks that the test above runs."""
    stored = notebook.NOTEBOOK.read_text(encoding="utf-8")
    page = notebook.PAGE.read_text(encoding="utf-8")
    assert stored == notebook.notebook(page), "python docs/tools/notebook.py"
    cells = json.loads(stored)["cells"]
    assert ["".join(cell["source"]) + "\n" for cell in cells if cell["cell_type"] == "code"] == PYTHON[notebook.PAGE]
    texts = "".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")
    for target in re.findall(r"\]\(([^)#]+)", texts):
        assert (notebook.NOTEBOOK.parent / target).is_file(), target


def test_code_on_the_pages_is_not_cut_in_a_window_of_1280_pixels() -> None:
    """Its widest line has 88 characters there; output, in blocks of `text`, wraps."""
    for page in PAGES:
        for language, block in re.findall(
            r"^```(\w+).*?\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.M
        ):
            too_wide = [line for line in block.splitlines() if len(line) > 88]
            assert language == "text" or not too_wide, f"{page.name}: {too_wide}"


def test_rows_of_a_table_stand_together() -> None:
    """After a blank line a row is the head of a table, else the site shows it as text."""
    for page in PAGES:
        for head, rule in re.findall(r"(?<=\n\n)(\|.*)\n(.*)", page.read_text(encoding="utf-8")):
            assert rule.startswith("| ---"), f"{page.name}: {head}"


def test_every_picture_has_a_description() -> None:
    """Which a screen reader reads in place of the picture."""
    for page in PAGES:
        for description, file in re.findall(r"!\[(.*?)\]\((.*?)\)", page.read_text(encoding="utf-8")):
            assert description, f"{page.name}: {file}"


def test_sections_of_docstrings_have_their_titles_on_lines_of_their_own() -> None:
    assert RUN_ON.search("Go.\n\n    Raises:     ValueError: it cannot.")
    documented = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
    nodes = ((path, node) for path in SOURCES for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    texts = [(path, ast.get_docstring(node) or "") for path, node in nodes if isinstance(node, documented)]
    assert any("Raises:\n" in text for _, text in texts)
    assert not [(path.name, text) for path, text in texts if RUN_ON.search(text)]


def test_documents_name_what_exists() -> None:
    """Every dotted name of a package in backticks is a module, or something in one."""
    pages = (path.read_text(encoding="utf-8") for path in [*PAGES, ROOT / "CONTRIBUTING.md"])
    named = {name for text in pages for name in re.findall(r"`((?:quadsim)(?:\.[A-Za-z_]+)+)`", text)}
    assert "quadsim.rollout.many.fly_many" in named
    for name in sorted(named - ENTRY_POINTS):
        resolve_name(name)


@pytest.mark.parametrize("name", drawings.DRAWINGS)
def test_drawings_are_those_of_the_code(name: str) -> None:
    drawn = (ROOT / "docs/assets" / name).read_text(encoding="utf-8")
    assert drawn == drawings.DRAWINGS[name](), "python docs/tools/drawings.py"
