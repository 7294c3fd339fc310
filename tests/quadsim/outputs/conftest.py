"""Fixtures of the tests of outputs."""

from __future__ import annotations

from pathlib import Path

import pytest
from output_trees import make

from quadsim.outputs import staging


@pytest.fixture(params=["renameat2", "two steps"])
def renaming(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each test also as on a file system that cannot swap two names at once."""
    if request.param == "two steps":
        monkeypatch.setattr(staging, "_renameat2", lambda *_: False)


@pytest.fixture
def ours(tmp_path: Path) -> Path:
    """A directory of ours, whole."""
    make(tmp_path / "run")
    return tmp_path / "run"
