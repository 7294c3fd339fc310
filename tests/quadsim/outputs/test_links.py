"""Nothing is read through a link that leads out of a directory of others."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from quadsim.errors import FileError
from quadsim.flight import rundir
from quadsim.outputs.paths import require_inside
from quadsim.report.pages.comparison_page import write_comparison
from scenarios.cli import main
from scenarios.commands import EXIT_WRONG_INPUT

SECRET = "the user's own"


@pytest.fixture
def run(short_run_directory: Path, tmp_path: Path) -> Path:
    """A copy of a run, and beside it what its maker must not get."""
    (tmp_path / "secret").mkdir()
    (tmp_path / "secret" / "key.png").write_text(SECRET)
    return shutil.copytree(short_run_directory, tmp_path / "run")


def linked_file(run: Path) -> None:
    (run / "flight.mp4").symlink_to(run.parent / "secret" / "key.png")


def linked_folder(run: Path) -> None:
    (run / "figures").symlink_to(run.parent / "secret")


def linked_deep(run: Path) -> None:
    (run / "figures").mkdir()
    (run / "figures" / "a.svg").symlink_to("../../secret/key.png")


def linked_table(run: Path) -> None:
    (run / "plant.parquet").rename(run.parent / "secret" / "plant.parquet")
    (run / "plant.parquet").symlink_to("../secret/plant.parquet")


def linked_summary(run: Path) -> None:
    (run / "summary.json").rename(run.parent / "secret" / "summary.json")
    (run / "summary.json").symlink_to("../secret/summary.json")


def chained(run: Path) -> None:
    (run / "b.png").symlink_to("../secret/key.png")
    (run / "flight.mp4").symlink_to("b.png")


def linked_to_nothing(run: Path) -> None:
    (run / "flight.mp4").symlink_to("../missing")


WAYS = [linked_file, linked_folder, linked_deep, linked_table, linked_summary, chained, linked_to_nothing]


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("command", ["check", "compare", "video", "view"])
def test_a_run_with_a_link_out_of_it_is_refused(
    run: Path, way: object, command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert callable(way)
    way(run)
    options = ["--out", str(tmp_path / "page")] if command == "compare" else []
    assert main([command, str(run), *options]) == EXIT_WRONG_INPUT
    printed = capsys.readouterr()
    assert f"is a link that leads out of {run}; nothing is read through it" in printed.err
    assert (printed.out, printed.err.count("\n")) == ("", 1)
    assert not (tmp_path / "page").exists()


def test_a_comparison_copies_nothing_through_a_link(run: Path, tmp_path: Path) -> None:
    loaded = rundir.load_run(run)
    linked_folder(run)  # after it was read
    with pytest.raises(FileError, match="is a link that leads out of"):
        write_comparison([loaded], tmp_path / "page")
    assert not (tmp_path / "page").exists()


def test_links_within_and_a_link_to_the_whole_are_no_harm(run: Path, tmp_path: Path) -> None:
    (run / "again.parquet").symlink_to("plant.parquet")
    (run / "circle").symlink_to("circle")
    (tmp_path / "latest").symlink_to("run")
    require_inside(tmp_path / "latest")
    assert rundir.read_summary(tmp_path / "latest")["scenario"] == "paper-constrained"
