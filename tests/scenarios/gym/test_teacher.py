"""A controller's answers as a table: what is in it, and who flew."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import quadsim
import quadsim.gym
from quadsim.controller import Moment
from quadsim.errors import OutputError
from scenarios.gym import teacher


def test_the_table_is_what_the_controller_answers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = quadsim.load("motion-capture").replace({"duration": 0.5})
    table = quadsim.gym.expert(scenario, episodes=2, seed=3, action="speeds", out=tmp_path / "a.parquet")
    assert pq.read_table(tmp_path / "a.parquet").equals(table)
    flight = quadsim.fly(scenario.replace({"seed": 3}), progress=False)
    assert table["episode"].to_pylist() == [0] * 10 + [1] * 10
    assert np.array_equal(np.array(table["action"].to_pylist())[:10], flight.command)
    layout = json.loads(table.schema.metadata[b"layout"])
    names = [entry["name"] for entry in layout]
    seen = np.array(table["observation"].to_pylist())
    assert np.array_equal(seen[:10, names.index("vz")], flight.measured["vz"])
    assert set(table["status"].to_pylist()) <= {"solved", "unconstrained"}
    monkeypatch.setattr(teacher, "make_env", None)  # refused before anything flies
    for place, message in (("a.parquet", "already there"), ("none/a.parquet", "no such directory|No such file")):
        with pytest.raises(OutputError, match=message):
            quadsim.gym.expert(scenario, out=tmp_path / place)


def test_the_teacher_corrects_another_pilot() -> None:
    scenario = quadsim.load("hover").replace({"duration": 0.5})
    still = np.zeros(4, np.float32)
    pushed = np.full(4, 0.05, np.float32)
    table = quadsim.gym.expert(scenario, agent=lambda seen: pushed if seen[4] < 1.01 else still, action="deviations")
    height = np.array(table["observation"].to_pylist())[:, 4]
    assert height.max() > 1.01
    law = quadsim.make_controller(scenario)
    seen, actions = np.array(table["observation"].to_pylist()), np.array(table["action"].to_pylist())
    env = quadsim.gym.QuadrotorEnv(scenario)
    law.reset(seen[0, -4:])
    for row, action in zip(seen, actions, strict=True):
        command = law.step(Moment(acting=row[-4:]), row[:12], row[12:-4].reshape(50, 4))
        assert env.actions.of(command.speeds) == pytest.approx(action, abs=1e-6)
