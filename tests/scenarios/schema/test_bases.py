"""Scenario files that hold only their differences from another."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from quadsim.assets import vehicle_path
from quadsim.errors import FileError
from quadsim.scenarios.loading import load_scenario
from quadsim.scenarios.schema.bases import merge
from quadsim.scenarios.schema.problems import ScenarioError


def write(directory: Path, name: str, text: str) -> str:
    (directory / name).write_text(text, encoding="utf-8")
    return str(directory / name)


def test_a_file_holds_only_what_differs(tmp_path: Path) -> None:
    mine = write(
        tmp_path,
        "mine.toml",
        """
        base = "paper-constrained"
        name = "mine"
        [vehicle]
        mass = 4.2
        [controller]
        horizon = 30
        [[constraints]]
        name = "roll"
        tolerance = 0.5
        [[constraints]]
        name = "climb"
        signal = "vz"
        upper = 3.0
        """,
    )
    result = load_scenario(mine)
    base = load_scenario("paper-constrained")
    assert (result.name, result.group, result.vehicle.mass, result.controller.horizon) == ("mine", "other", 4.2, 30)
    assert result.reference == base.reference
    changed = "controller.horizon = 30; constraints.roll.tolerance = 0.5; constraints.climb.signal = "
    assert result.description.startswith(f"{base.description} (changed: ")
    assert changed in result.description
    assert [entry.name for entry in result.constraints] == [*(entry.name for entry in base.constraints), "climb"]
    assert result.constraints[0] == replace(base.constraints[0], tolerance=0.5)
    assert result.constraints[1:-1] == base.constraints[1:]


def test_bases_have_bases_and_paths_are_their_own(tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    write(tmp_path / "deep", "light.toml", vehicle_path("lopes2011").read_text(encoding="utf-8"))
    write(tmp_path / "deep", "first.toml", 'base = "hover"\nname = "first"\nvehicle = { file = "light.toml" }\n')
    top = write(tmp_path, "top.toml", 'base = "deep/first.toml"\nname = "top"\nduration = 2.0\n')
    result = load_scenario(top, ["duration=3.0"])
    assert (result.name, result.duration) == ("top", 3.0)
    assert result.vehicle.file == str((tmp_path / "deep" / "light.toml").resolve())


def test_another_type_replaces_a_table() -> None:
    base = {"reference": {"x": [1], "response_time": 2.0}, "controller": {"type": "constrained", "horizon": 5}}
    circle = {"type": "circle", "radius": 1.0}
    assert merge(base, {"reference": circle})["reference"] == circle
    assert merge(base, {"controller": {"type": "constrained", "solver": "daqp"}})["controller"] == {
        "type": "constrained",
        "horizon": 5,
        "solver": "daqp",
    }
    assert base["reference"]["x"] == [1]  # what was given is left alone


def test_lists_without_names_are_replaced() -> None:
    assert merge({"events": [{"at": 1.0}, {"at": 2.0}]}, {"events": [{"at": 3.0}]}) == {"events": [{"at": 3.0}]}


def test_circular_bases_are_reported(tmp_path: Path) -> None:
    write(tmp_path, "a.toml", 'base = "b.toml"\n')
    write(tmp_path, "b.toml", 'base = "a.toml"\n')
    with pytest.raises(FileError, match=r"a\.toml -> b\.toml -> a\.toml"):
        load_scenario(str(tmp_path / "a.toml"))


MISSING = [f"controller.{name} is missing" for name in ("horizon", "output_weights")]
WHOLE = (
    "controller: of another type than that of its base ('constrained' in hover.toml), it replaces it whole and "
    "inherits nothing"
)


@pytest.mark.parametrize("controller", ['controller = "robust"', '[controller]\ntype = "robust"'])
def test_a_table_of_another_type_reports_why_it_has_none_of_its_bases_fields(tmp_path: Path, controller: str) -> None:
    (tmp_path / "mine.toml").write_text(f'base = "hover"\n{controller}\n')
    (tmp_path / "above.toml").write_text('base = "mine.toml"\nduration = 3.0\n')
    for name in ("mine.toml", "above.toml"):
        with pytest.raises(ScenarioError) as caught:
            load_scenario(str(tmp_path / name))
        assert caught.value.problems == (*MISSING, WHOLE)
