"""Numbers of papers flown again: the short ones of every paper, and the messages for one that is off."""

from __future__ import annotations

import csv
import json
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

import quadsim
from quadsim.commands.cli import main
from quadsim.console.results import EXIT_DONE, EXIT_FAILED, EXIT_WRONG_INPUT
from quadsim.errors import FileError, UnknownNameError
from quadsim.features.papers.reproduction import (
    COUNTED,
    NUMBER_KINDS,
    PaperNumber,
    Reproduced,
    Reproduction,
    load_paper,
    reproduce_paper,
)
from quadsim.report.table import grid_to_markdown
from quadsim.rollout.flown import Flight
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.catalogue import paper_names, scenario_names
from quadsim.scenarios.loading import load_scenario
from quadsim.scenarios.schema.problems import ScenarioError

pytestmark = pytest.mark.slow("papers")

ROOT = Path(__file__).resolve().parents[3]
HEAD = 'title = "A paper"\nauthors = "N. N."\nabout = "A hover"\n'
NUMBER = """
[[numbers]]
name = "time flown"
scenario = "hover"
set = { duration = 0.5, controller = { type = "pid" } }
measure = "duration"
unit = "s"
published = %s
%s
source = "here"
"""


def written(folder: Path, *numbers: tuple[str, str]) -> str:
    path = folder / "paper.toml"
    path.write_text(HEAD + "".join(NUMBER % number for number in numbers))
    return str(path)


@pytest.fixture(scope="module")
def loop4(fly_once: Callable[..., Flight]) -> Reproduction:
    """The short flights of Torrente et al., as CI flies them; `test_library` has them, too."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Rollout, "fly", lambda rollout: fly_once(rollout.scenario.name))
        paper = load_paper("torrente2021")
        short = [n for n in paper.numbers if n.scenario.startswith("torrente-loop4") and not n.set]
        return reproduce_paper(replace(paper, numbers=short))


def test_the_circle_at_4_m_s_is_reproduced(loop4: Reproduction) -> None:
    assert [number.spec.authors_code for number in loop4.numbers] == [0.0001, 0.1162, [0.1163, 0.1164]]
    assert loop4.within, [number.sentence for number in loop4.numbers]


def test_its_errors_have_the_digits_of_the_specification(loop4: Reproduction) -> None:
    """Five decimals of a separate implementation; with noise its mean and deviation over seeds."""
    ideal, drag, noise = (number.ours for number in loop4.numbers)
    assert ideal == pytest.approx(0.00012, abs=5e-6)
    assert drag == pytest.approx(0.11620, abs=5e-6)
    assert noise == pytest.approx(0.1164, abs=2e-4)


def test_the_first_seconds_at_8_m_s_are_those_of_the_specification() -> None:
    """Positions under drag at 2 s and 5 s, where it is fastest; the heading has turned by then."""
    flight = Rollout(load_scenario("torrente-loop8-drag", ["duration=5.02"])).fly()
    positions = flight.log.control.truth[[100, 250], 0:6:2]
    expected = [[0.586204, -0.036271, 1.003212], [4.944455, -5.120605, 1.068593]]
    np.testing.assert_allclose(positions, expected, atol=1e-6)


@pytest.mark.representative("papers")
def test_every_shipped_number_names_a_flight_that_can_be_flown() -> None:
    assert {"quadrotor-uav", "torrente2021"} <= {*paper_names()}
    papers = [load_paper(name) for name in paper_names()]
    for paper in papers:
        for number in paper.numbers:
            paper.scenario_of(number)
        names = [number.name for number in paper.numbers]
        assert len(set(names)) == len(names)
    flown = {number.scenario for paper in papers for number in paper.numbers}
    assert {name for name in scenario_names() if load_scenario(name).group == "papers"} <= flown


@pytest.mark.representative("papers")
@pytest.mark.parametrize(
    ("relation", "ours", "within"),
    [
        ("equal", 1.01, True),
        ("equal", 1.02, False),
        ("at most", 0.5, True),
        ("at most", 1.02, False),
        ("at least", 1.5, True),
        ("at least", 0.98, False),
    ],
)
def test_a_number_is_judged_by_its_relation_and_tolerance(relation: Any, ours: float, within: bool) -> None:
    spec = PaperNumber(name="n", scenario="hover", published=1.0, relation=relation, absolute=0.01, source="s")
    assert Reproduced(spec=spec, ours=ours).within is within


def test_a_flight_that_ends_early_reproduces_nothing(tmp_path: Path) -> None:
    path = Path(written(tmp_path, ("0.5", "absolute = 1.0")))
    path.write_text(
        path.read_text().replace(
            "duration = 0.5",
            "duration = 0.5, lost = { depth = 1e-6 }, initial = "
            "{ position = [0.0, 0.0, 1.0], euler = [20.0, 0.0, 0.0] }",
        )
    )
    (result,) = quadsim.reproduce(path, progress=False)
    assert result.numbers[0].ours is None
    assert not result.within
    assert "depth" in result.numbers[0].sentence
    assert "| time flown | s | 0.5 | - | - | 1 | no |" in grid_to_markdown(result.grid)


@pytest.mark.representative("papers")
def test_the_command_prints_and_fails_beyond_tolerance(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good = written(tmp_path, ("0.5", "absolute = 0.0"))
    report = tmp_path / "verdicts.xml"
    assert main(["reproduce", good, "--junit", str(report)]) == EXIT_DONE
    capsys.readouterr()
    assert ElementTree.parse(report).getroot().attrib["failures"] == "0"
    off = written(tmp_path, ("0.5", "absolute = 0.0"), ("0.6", "relative = 0.01"))
    assert main(["reproduce", off, "--json", "--junit", str(report)]) == EXIT_FAILED
    result = json.loads(capsys.readouterr().out)
    assert not result["reproduced"]
    first, second = result["papers"][0]["numbers"]
    assert first["within"]
    assert not second["within"]
    assert (second["published"], second["ours"], second["tolerance"]) == (0.6, 0.5, pytest.approx(0.006))
    assert second["difference"] == pytest.approx(-0.1)
    assert (second["kind"], second["authors_code"], second["other_implementation"]) == ("published", None, None)
    assert result["papers"][0]["counts"] == {"published": {"within": 1, "of": 2}}
    root = ElementTree.parse(report).getroot()
    assert root.attrib["failures"] == "1"
    assert "0.5 s" in root.findtext("testcase/system-out", "")


@pytest.mark.representative("papers")
def test_only_what_a_paper_prints_of_what_is_flown_is_called_published() -> None:
    """Three kinds by their sources, counted apart; bars and claims are no reproduced numbers."""
    numbers = load_paper("torrente2021").numbers
    sources = {
        "published": "published",
        "authors_code": "obtained by running the public code",
        "other_implementation": "another implementation",
    }
    for number in numbers:
        assert number.source.startswith(sources[number.kind]), number.name
    assert Counter(number.counted_as for number in numbers) == {
        "published": 1,
        "authors_code": 8,
        "other_implementation": 9,
        "bar": 2,
    }
    for number in load_paper("quadrotor-uav").numbers:
        assert (number.kind, number.role) == ("published", "claim")


@pytest.mark.representative("papers")
def test_each_kind_has_its_column_and_its_count() -> None:
    paper = load_paper("torrente2021")
    numbers = tuple(Reproduced(spec=number, ours=number.span[0]) for number in paper.numbers)
    missed = (replace(numbers[0], ours=1.0), *numbers[1:])
    text = "published: 1 of 1 of the nominal controller; by the authors' code: %d of 8; "
    text += "by another implementation: 9 of 9; bars of something else, met: 2 of 2"
    assert Reproduction(paper=paper, numbers=numbers).sentence == text % 8
    assert Reproduction(paper=paper, numbers=missed).sentence == text % 7
    grid = Reproduction(paper=paper, numbers=numbers).grid
    assert grid.note.startswith(text % 8)
    assert grid.head[2:5] == ("published", "authors' code", "other code")
    stated = {cells[0].text: [cell.text for cell in cells[2:5]] for cells in grid.lines}
    assert stated["circle, 8 m/s, drag, noise"] == ["0.241", "-", "-"]
    assert stated["circle, 4 m/s, drag, noise"] == ["-", "0.1163 to 0.1164", "-"]
    assert stated["circle, drag: true RMS"] == ["-", "-", "0.29523"]
    claims = load_paper("quadrotor-uav")
    confirmed = Reproduction(
        paper=claims, numbers=tuple(Reproduced(spec=claim, ours=claim.span[0]) for claim in claims.numbers)
    )
    assert confirmed.sentence == "claims checked and confirmed: 18 of 18"
    assert confirmed.grid.head[2:4] == ("claimed", "ours")


@pytest.mark.representative("papers")
def test_the_table_of_the_page_states_each_kind() -> None:
    rows = list(csv.DictReader((ROOT / "docs/data/papers.csv").read_text(encoding="utf-8").splitlines()))
    for name in paper_names():
        paper = load_paper(name)
        of_paper = [row for row in rows if row["paper"] == paper.title]
        assert [row["name"] for row in of_paper] == [number.name for number in paper.numbers]
        for row, number in zip(of_paper, paper.numbers, strict=True):
            assert [kind for kind in NUMBER_KINDS if row[kind]] == [number.kind]
            assert row["role"] == number.role
        page = (ROOT / "docs/evidence.md").read_text(encoding="utf-8")
        (line,) = re.findall(rf"^- \*{paper.title}\*.*$", page, re.MULTILINE)
        for name, count in Counter(number.counted_as for number in paper.numbers).items():
            assert re.search(rf"{COUNTED[name]}: \d+ of {count}\b", line, re.IGNORECASE), name


def test_a_scenario_beside_the_papers_file_is_found(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text('base = "hover"\nname = "mine"\ndescription = "mine"\n')
    path = Path(written(tmp_path, ("0.5", "absolute = 0.0")))
    path.write_text(path.read_text().replace('scenario = "hover"', 'scenario = "mine.toml"'))
    paper = load_paper(str(path))
    assert paper.scenario_of(paper.numbers[0]).name == "mine"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("absolute = 0.0", "", "time flown.absolute must be given, or relative, but not both"),
        (
            "published = 0.5",
            "published = [0.6, 0.5]",
            "published must be a lower and a higher number of relation equal",
        ),
        (
            "published = 0.5",
            "published = 0.5\nauthors_code = 0.5",
            "exactly one of published, authors_code, other_implementation must be given; got published, authors_code",
        ),
        ("published = 0.5", "", "other_implementation must be given; got none"),
        (
            "published = 0.5",
            'authors_code = 0.5\nrole = "bar"',
            "role must be number where published is absent; got bar",
        ),
    ],
)
def test_a_wrong_file_is_refused(old: str, new: str, message: str, tmp_path: Path) -> None:
    path = Path(written(tmp_path, ("0.5", "absolute = 0.0")))
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(ScenarioError, match=re.escape(message)):
        load_paper(str(path))


def test_what_cannot_be_flown_or_measured_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = Path(written(tmp_path, ("0.5", "absolute = 0.0"))).read_text()
    path = tmp_path / "other.toml"
    for old, new, message in (
        ('"duration"', '"tracking.rmse.w"', "got 'tracking.rmse.w' (tracking.rmse has: x, y, z, yaw"),
        ("duration = 0.5", "durations = 0.5", "durations is not a field of the scenario file"),
        ('"hover"', '"hovers"', "no scenario named 'hovers'"),
    ):
        path.write_text(text.replace(old, new))
        assert main(["reproduce", str(path)]) == EXIT_WRONG_INPUT
        assert message in capsys.readouterr().err
    for name, kind in (("torrente2020", UnknownNameError), (str(tmp_path / "none.toml"), FileError)):
        with pytest.raises(kind):
            quadsim.reproduce(name, progress=False)
