"""A campaign with a hostile controller in many of its flights, and the same one without: what differs, who is left.

python tests/safety_campaign.py --flights 60
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time as clock
import uuid
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import tomlkit
from hostile_controller import ENDED, KINDS

from scenarios.campaign.engine.protocol import MOST_DEATHS
from scenarios.campaign.results.store import FLIGHTS_FILE
from scenarios.campaign.results.table import Row

ROOT = Path(__file__).resolve().parents[1]
LIMITS = {"flight": 20.0, "step": 3.0, "memory": 300.0}  # a busy machine takes a second to fill the memory
MAIN = """
import sys
from scenarios.campaign.engine import local
from scenarios.entry import main
local.MOST_DEATHS = {deaths}
sys.exit(main())
"""
CAMPAIGN: dict[str, Any] = {
    "name": "hostile",
    "scenario": "hover",
    "seed": 4,
    "limits": LIMITS,
    "set": {
        "duration": 0.5,
        "constraints": [],
        "controller": {"type": "hostile_controller:Hostile", "horizon": 2, "folder": str(Path(__file__).parent)},
    },
    "vary": [
        {"name": "kind", "fields": ["controller.settings.kind"], "distribution": "grid"},
        {
            "name": "mass",
            "fields": ["effects.load.mass_factor"],
            "distribution": "uniform",
            "low": 0.9,
            "high": 1.1,
        },
    ],
}


@dataclass(frozen=True, kw_only=True)
class Flown:
    """A campaign that was flown.

    Attributes:
        rows: of its flights.
        seconds: that it took.
        left: processes that outlived it.
        output: on stderr.
    """

    rows: list[Row]
    seconds: float
    left: int
    output: str


def write(directory: Path, kinds: Sequence[str], *, armed: bool) -> Path:
    """The file of a campaign whose flights do harm, or would if they were armed; see `fly`."""
    names = [f"{i} {kind}" for i, kind in enumerate(kinds)]  # a grid's values are distinct
    kind, *others = CAMPAIGN["vary"]
    controller = {**CAMPAIGN["set"]["controller"], "settings": {"kind": "calm", "armed": armed}}
    changes = {"flights": len(kinds), "vary": [{**kind, "values": names}, *others]}
    changes["set"] = {**CAMPAIGN["set"], "controller": controller}
    file = directory / "hostile.toml"
    file.write_text(tomlkit.dumps({**CAMPAIGN, **changes}), encoding="utf-8")
    return file


def fly(directory: Path, kinds: Sequence[str], *, armed: bool, workers: int = 2, deaths: int = MOST_DEATHS) -> Flown:
    """Fly a campaign whose flights do harm, or would if they were armed, one after the other.

    Args:
        directory: an empty one, for what it writes.
        kinds: of each flight; see `hostile_controller.KINDS`.
        armed: whether they do.
        workers: how many.
        deaths: processes that may die of a flight.
    """
    file = write(directory, kinds, armed=armed)
    command = [sys.executable, "-c", MAIN.format(deaths=deaths), "campaign", str(file), "--out", str(directory / "out")]
    mark = f"QUADSIM_MARK={uuid.uuid4()}"
    started = clock.perf_counter()
    ran = subprocess.run(
        [*command, "--workers", str(workers), "--json", "--no-report"],
        env={**os.environ, "PYTHONPATH": str(ROOT)} | dict([mark.split("=")]),
        capture_output=True,
        check=False,
        timeout=600.0,
    )
    seconds = clock.perf_counter() - started
    if ran.returncode != 0:
        raise RuntimeError(f"the campaign ended with {ran.returncode}: {ran.stderr.decode()[-2000:]}")
    json.loads(ran.stdout)  # whatever controllers print, this is the campaign's answer alone
    clock.sleep(0.2)
    rows = pq.read_table(directory / "out" / FLIGHTS_FILE).to_pylist()
    return Flown(rows=rows, seconds=seconds, left=_marked(mark), output=ran.stderr.decode())


def _marked(mark: str) -> int:
    """Processes that were started with a mark in their environment."""
    found = 0
    for environment in Path("/proc").glob("[0-9]*/environ"):
        with contextlib.suppress(OSError):
            found += mark.encode() in environment.read_bytes().split(b"\0")
    return found


def planned(flights: int) -> list[str]:
    """The kind of each flight: every kind of harm once, where there are so many flights, calm ones evenly between."""
    kinds = sorted(KINDS)[:flights]
    positions = {round((i + 0.5) * flights / len(kinds) - 0.5): kind for i, kind in enumerate(kinds)}
    return [positions.get(flight, "calm") for flight in range(flights)]


def measure(flights: int = 60, *, workers: int = 2, deaths: int = MOST_DEATHS) -> dict[str, int]:
    """Fly a campaign with hostile flights, and one in which they are calm.

    Args:
        flights: of each of the two.
        workers: how many fly them.
        deaths: processes that may die of a flight.

    Returns:
        `flights`; `hostile` ones, and those of each verdict (`hostile: error`); `calm` ones, and of these those whose
        `rows differ` from the campaign without hostile ones; `unexpected verdicts` of hostile ones, and each of these
        by name; `leftover processes`.
    """
    kinds = planned(flights)
    with tempfile.TemporaryDirectory() as directory:
        folders = [Path(directory, name) for name in ("calm", "hostile")]
        for folder in folders:
            folder.mkdir()
        calm, hostile = (
            fly(folder, kinds, armed=armed, workers=workers, deaths=deaths)
            for folder, armed in zip(folders, (False, True), strict=True)
        )
    flown = list(zip(kinds, calm.rows, hostile.rows, strict=True))
    verdicts = Counter(row["verdict"] for kind, _, row in flown if kind != "calm")
    unexpected = [
        f"unexpected: {kind} ended with {row['verdict']} ({row['reason']})"
        for kind, _, row in flown
        if kind != "calm" and row["verdict"] != ENDED.get(kind, "satisfied")
    ]
    return {
        "flights": flights,
        "hostile": sum(kind != "calm" for kind in kinds),
        **{f"hostile: {verdict}": count for verdict, count in sorted(verdicts.items())},
        "calm": kinds.count("calm"),
        "rows differ": sum(kind == "calm" and repr(row) != repr(other) for kind, other, row in flown),
        "unexpected verdicts": len(unexpected),
        **dict.fromkeys(unexpected, 1),
        "leftover processes": calm.left + hostile.left,
    }


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=60)
    counts = measure(parser.parse_args().flights)
    for name, count in counts.items():
        print(f"{name}: {count}")
    return 1 if counts["rows differ"] or counts["unexpected verdicts"] or counts["leftover processes"] else 0


if __name__ == "__main__":
    sys.exit(main())
