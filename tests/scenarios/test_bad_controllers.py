"""A campaign outlives its user's controllers: time, memory, death and exceptions cost one flight each, and no other."""

from __future__ import annotations

import os
import subprocess
import sysconfig
from pathlib import Path

import pyarrow.parquet as pq
import tomlkit
from hostile_controller import KINDS, VERDICTS


def environment_in(path: Path) -> list[str]:
    """What a process was started with; nothing where it has ended or is another user's."""
    try:
        return path.read_text(errors="replace").split("\0")
    except OSError:
        return []


def fly(directory: Path, kinds: list[str]) -> list[dict[str, object]]:
    """The rows of a campaign with a flight of each kind; no process of it is left."""
    file, mark = directory / "campaign.toml", f"QUADSIM_MARK={directory}"
    names = [f"{i} {kind}" for i, kind in enumerate(kinds)]  # a grid's values are distinct
    law = {"type": "hostile_controller:Hostile", "horizon": 2, "folder": str(Path(__file__).parents[1])}
    mass = {"name": "mass", "fields": ["effects.load.mass_factor"], "distribution": "uniform", "low": 0.9, "high": 1.1}
    campaign = {
        "name": "hostile",
        "scenario": "hover",
        "flights": len(kinds),
        "limits": {"flight": 6.0, "memory": 300.0},
        "set": {"duration": 0.5, "constraints": [], "controller": law},
        "vary": [
            {"name": "kind", "fields": ["controller.settings.kind"], "distribution": "grid", "values": names},
            mass,
        ],
    }
    file.write_text(tomlkit.dumps(campaign), encoding="utf-8")
    out, program = directory / "out", Path(sysconfig.get_path("scripts")) / "quadsim"
    command = [program, "campaign", file, "--out", out, "--workers", "2", "--no-report"]
    environment = os.environ | dict([mark.split("=")])
    done = subprocess.run(
        command, cwd=directory, env=environment, capture_output=True, text=True, check=False, timeout=300.0
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("imported hostile_controller from ") == 1
    assert [path for path in Path("/proc").glob("[0-9]*/environ") if mark in environment_in(path)] == []
    rows: list[dict[str, object]] = pq.read_table(out / "flights.parquet").to_pylist()
    return rows


def test_each_kind_of_harm_is_one_row_and_changes_no_other(tmp_path: Path) -> None:
    kinds = [name for kind in KINDS for name in (kind, "calm")]
    for name in ("hostile", "calm"):
        (tmp_path / name).mkdir()
    hostile, calm = fly(tmp_path / "hostile", kinds), fly(tmp_path / "calm", ["calm"] * len(kinds))
    for kind, row, undisturbed in zip(kinds, hostile, calm, strict=True):
        if kind == "calm":
            assert repr({**row, "kind": None}) == repr({**undisturbed, "kind": None})
        else:
            assert row["verdict"] in VERDICTS[KINDS[kind]], (kind, row["verdict"], row["reason"])
