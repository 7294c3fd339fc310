"""Files of other versions and damaged summaries: one message that says what to do, never a traceback."""

from __future__ import annotations

import copy
import json
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from support import NO_PRODUCTS

import quadsim
from quadsim.commands.cli import main
from quadsim.errors import FileError
from quadsim.flight.parquet import FORMAT
from quadsim.rollout.reaudit import reaudit


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short flight with events, ground and a violated constraint, as written."""
    changes = {"duration": 1.0, "constraints.roll.upper": 0.001, "initial.euler": [0.0, 0.0, 20.0]}
    flight = quadsim.fly(quadsim.load("hover").replace(changes))
    return flight.save(tmp_path_factory.mktemp("versions") / "run", **NO_PRODUCTS)


def rewritten(run: Path, tmp_path: Path, summary: Any) -> Path:
    """The run with another summary."""
    other = tmp_path / "run"
    other.mkdir(exist_ok=True)
    for file in run.iterdir():
        (other / file.name).write_bytes(file.read_bytes())
    (other / "summary.json").write_text(json.dumps(summary), encoding="utf-8")
    return other


def summary_of(run: Path) -> dict[str, Any]:
    return dict(json.loads((run / "summary.json").read_text(encoding="utf-8")))


def test_tables_and_summaries_state_their_format(run: Path) -> None:
    assert summary_of(run)["format"] == FORMAT
    for name in ("flight", "timing", "plant"):
        assert pq.read_schema(run / f"{name}.parquet").metadata[b"format"] == str(FORMAT).encode()


@pytest.mark.parametrize("stated", [1, None, "7"])
def test_a_run_of_another_version_says_how_to_fly_it_again(
    run: Path, tmp_path: Path, stated: object, capsys: pytest.CaptureFixture[str]
) -> None:
    summary = {key: value for key, value in summary_of(run).items() if key != "format"}
    other = rewritten(run, tmp_path, summary if stated is None else {**summary, "format": stated})
    for command in ("check", "compare", "video"):
        assert main([command, str(other)]) == 2
        message = capsys.readouterr().err
        assert f"quadsim run {shlex.quote(str(other / 'scenario.toml'))}" in " ".join(message.split())


def test_a_campaign_of_another_version_says_how_to_fly_it_again(tmp_path: Path) -> None:
    vary = [{"name": "m", "fields": ["actual.mass"], "distribution": "uniform", "low": 3.9, "high": 4.1}]
    out = tmp_path / "campaign"
    scenario = quadsim.load("hover").replace({"duration": 0.5})
    quadsim.campaign(scenario, vary=vary, flights=1, workers=1, out=out)
    manifest = json.loads((out / "manifest.json").read_text(encoding="utf-8"))
    del manifest["version"]
    (out / "manifest.json").write_text(json.dumps(manifest), encoding="utf-8")
    with pytest.raises(FileError, match="version"):
        quadsim.replay(out, worst=True)


def damages(data: Any, path: tuple[str | int, ...] = ()) -> Iterator[tuple[tuple[str | int, ...], Any]]:
    """Every place of a summary, with what may stand there by mistake."""
    if path:
        yield from ((path, value) for value in (None, "x", {"x": None}))
    entries = data.items() if isinstance(data, dict) else enumerate(data[:1]) if isinstance(data, list) else ()
    for key, value in entries:
        yield from damages(value, (*path, key))


def damaged(summary: dict[str, Any], path: tuple[str | int, ...], value: Any) -> dict[str, Any]:
    other = copy.deepcopy(summary)
    holder: Any = other
    for key in path[:-1]:
        holder = holder[key]
    holder[path[-1]] = value
    return other


@pytest.mark.slow("process")
def test_a_damaged_summary_is_one_message_whatever_is_damaged(run: Path, tmp_path: Path) -> None:
    summary = summary_of(run)
    refused = 0
    for path, value in damages(summary):
        other = rewritten(run, tmp_path, damaged(summary, path, value))
        try:
            for _ in reaudit(other).shown():
                pass
        except FileError:
            refused += 1
    assert refused > 200, "or the summary is not read"
