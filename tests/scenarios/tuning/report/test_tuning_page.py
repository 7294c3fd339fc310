"""The page of a tuning: whole, offline, with links to files that are there; and its tables and sentences."""

from __future__ import annotations

import re

import pytest
from support import sketch_figures
from tuning_formula import Formula, tune_by, write_tuning

from quadsim.report.table import Mark
from scenarios.tuning.plan import load_tuning
from scenarios.tuning.report.tuning_tables import candidate_table, objective_table, sentences, verdict_sentence
from scenarios.tuning.run import TuningResult

OBJECTIVES = [
    {"name": "error", "expression": "rmse.x", "unit": "m"},
    {"name": "calm", "expression": "rmse.x * draw.mass"},
]


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> TuningResult:
    here = tmp_path_factory.mktemp("tuning")
    plan = load_tuning(str(write_tuning(here, objectives=OBJECTIVES, trials=12, description="a <b>bowl</b>")))
    with pytest.MonkeyPatch.context() as patch:
        sketch_figures(patch)
        return tune_by(Formula(), plan, here / "t")


def test_the_page_links_to_what_is_there(result: TuningResult) -> None:
    page = (result.directory / "index.html").read_text(encoding="utf-8")
    links = re.findall(r'href="([^"#:]+)"', page)
    assert {"best.toml", "start/index.html", "journal.log"} <= set(links)
    assert f"candidate-{result.summary['answer']}/index.html" in links
    assert "comparison/index.html" in links
    assert [link for link in links if not (result.directory / link).is_file()] == []
    assert "a &lt;b&gt;bowl" in page
    assert set(re.findall(r'<div class="plot" id="(\w+)"', page)) == {"candidates", "importance", "pairs"}
    assert "://" not in re.sub(r"<script>.*?</script>|<script type.*?</script>", "", page, flags=re.DOTALL)


def test_tables_and_sentences_have_the_summary_s_numbers(result: TuningResult) -> None:
    summary = result.summary
    lines = candidate_table(summary).lines
    assert lines[0][0].text in ("start", *map(str, summary["front"]))
    bold = {line[0].text for line in lines if line[1].mark is Mark.BEST}
    assert bold <= {"start", *map(str, summary["front"])}
    assert [line[0].text for line in objective_table(summary).lines] == ["error [m]", "calm"]
    output = " ".join([verdict_sentence(summary), *sentences(summary)])
    assert f"{summary['search_flights']} flights" in output
    assert "Of the answer: P(violation) < 0.2 @ 50% holds: violation in 0 of 20 flights" in output
