"""The page of a tuning: Optuna's plots, offline, with links to files that are there; and its tables."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from tuning_formula import Formula, tune_by, write_tuning

from scenarios.tuning.page import sentences, tables, verdict
from scenarios.tuning.plan import load_tuning
from scenarios.tuning.run import TuningResult

ERROR = {"name": "error", "expression": "rmse.x", "unit": "m"}
CALM = {"name": "calm", "expression": "rmse.x * draw.mass"}


def tuned(directory: Path, *objectives: dict[str, str]) -> TuningResult:
    plan = load_tuning(str(write_tuning(directory, objectives=objectives, trials=12, description="a <b>bowl</b>")))
    return tune_by(Formula(), plan, directory / "t")


@pytest.mark.parametrize("objectives", [(ERROR,), (ERROR, CALM)])
def test_the_page_has_optunas_plots_and_links_to_what_is_there(
    tmp_path: Path, objectives: tuple[dict[str, str]]
) -> None:
    result = tuned(tmp_path, *objectives)
    page = (result.directory / "index.html").read_text(encoding="utf-8")
    links = re.findall(r'href="([^"#:]+)"', page)
    pages = {"start/index.html", f"candidate-{result.summary['answer']}/index.html", "comparison/index.html"}
    assert pages | {"best.toml", "journal.log"} <= set(links)
    assert [link for link in links if not (result.directory / link).is_file()] == []
    assert "a &lt;b&gt;bowl" in page
    plots = {"candidates", *(f"{kind}{i}" for i in range(len(objectives)) for kind in ("importance", "slice"))}
    assert set(re.findall(r'<div class="plot" id="(\w+)"', page)) == plots
    assert "://" not in re.sub(r"<script>.*?</script>|<script type.*?</script>", "", page, flags=re.DOTALL)
    assert [line[0].text for line in tables(result.summary)[0].lines] == ["error [m]", "calm"][: len(objectives)]
    assert verdict(result.summary) in page
    assert "violation in 0 of 20 flights" in sentences(result.summary)[0]
