"""A campaign whose processes are killed at random instants: nothing is lost, nothing there twice, the totals the same.

    python tests/campaign_kills.py --kills 100 --flights 200

SIGKILL takes, in random order, the workers, the server they are started from, and the campaign's own process; after
that one's death the campaign goes on with --resume.  At the end the table has to be, byte for byte, that of a campaign
that nobody disturbed.
"""

from __future__ import annotations

import argparse
import contextlib
import signal
import subprocess
import sys
import tempfile
import time as clock
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
import pyarrow.parquet as pq

CAMPAIGN = """
name = "killed"
scenario = "paper-constrained"
flights = {flights}
failure = ["lost", "rmse.z > 0.36"]
set = {{ duration = {duration}, constraints = []{settings} }}

[[vary]]
name = "mass"
fields = ["effects.load.mass_factor"]
distribution = "uniform"
low = 0.9
high = 1.1
"""
CHANCES = {"campaign": 0.1, "server": 0.1, "worker": 0.8}
"""Of what is killed: the campaign's own process, one that it starts workers from, or a worker."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What came of it.

    Attributes:
        kills: how many, by what was killed.
        lost: flights that are not in the table.
        doubled: flights that are there more than once.
        same: whether the table is, byte for byte, that of an undisturbed campaign.
        seconds: wall time of the disturbed one [s].
    """

    kills: Counter[str]
    lost: int
    doubled: int
    same: bool
    seconds: float


def kill_and_resume(
    directory: Path, *, kills: int, flights: int, duration: float, pause: float, seed: int, settings: str = ""
) -> Outcome:
    """Fly a campaign twice, once undisturbed.

    Args:
        directory: an empty one.
        kills: how many processes to kill; fewer are if the campaign is over before.
        flights: of the campaign.
        duration: of each [s].
        pause: mean time between kills [s].
        seed: of when and what to kill.
        settings: further ones of the flown scenario, as they stand in a table of TOML.

    Raises:
        RuntimeError: the campaign ended with an error of its own.
    """
    file = directory / "killed.toml"
    file.write_text(CAMPAIGN.format(flights=flights, duration=duration, settings=settings), encoding="utf-8")
    command = [sys.executable, "-m", "scenarios.cli", "campaign", str(file), "--workers", "2", "--json", "--no-report"]
    subprocess.run([*command, "--out", str(directory / "calm")], check=True, stdout=subprocess.DEVNULL)
    rng = np.random.default_rng(seed)
    order = rng.choice(list(CHANCES), size=kills, p=list(CHANCES.values())).tolist()
    killed: Counter[str] = Counter()
    disturbed = [*command, "--out", str(directory / "disturbed"), "--resume"]
    started = clock.perf_counter()
    campaign = subprocess.Popen(disturbed, stdout=subprocess.DEVNULL)
    try:
        for what in order:
            while campaign.poll() is None:
                clock.sleep(rng.exponential(pause))
                if _kill_one(campaign, what, rng):
                    killed[what] += 1
                    break
            if campaign.poll() == -signal.SIGKILL:
                campaign = subprocess.Popen(disturbed, stdout=subprocess.DEVNULL)
            elif campaign.poll() is not None:
                break
        if campaign.wait(timeout=600.0) != 0:
            raise RuntimeError(f"the campaign ended with exit status {campaign.returncode}")
    finally:
        campaign.kill()
    seconds = clock.perf_counter() - started
    calm, table = (directory / name / "flights.parquet" for name in ("calm", "disturbed"))
    counts = Counter(pq.read_table(table)["flight"].to_pylist())
    return Outcome(
        kills=killed,
        lost=len(set(range(flights)) - set(counts)),
        doubled=sum(count > 1 for count in counts.values()),
        same=calm.read_bytes() == table.read_bytes(),
        seconds=seconds,
    )


def _kill_one(campaign: subprocess.Popen[bytes], what: str, rng: np.random.Generator) -> bool:
    """Kill a process of that kind; False where there is none at the moment."""
    with contextlib.suppress(psutil.NoSuchProcess):
        parent = psutil.Process(campaign.pid)
        below = parent.children(recursive=True)
        processes = {
            "campaign": [parent],
            "server": [child for child in below if child.ppid() == parent.pid and _is_server(child)],
            "worker": [child for child in below if child.ppid() != parent.pid],
        }[what]
        if processes:
            processes[rng.integers(len(processes))].kill()
            return what != "campaign" or campaign.wait() == -signal.SIGKILL
    return False


def _is_server(process: psutil.Process) -> bool:
    """Whether workers are started from it; the other child of a campaign is Python's resource tracker."""
    return "forkserver" in " ".join(process.cmdline())


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--flights", type=int, default=200)
    parser.add_argument("--duration", type=float, default=60.0, help="of a flight [s]")
    parser.add_argument("--pause", type=float, default=0.7, help="mean time between kills [s]")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        outcome = kill_and_resume(Path(directory), **vars(options))
    what = ", ".join(f"{count} of a {name}" for name, count in outcome.kills.items())
    print(f"{outcome.kills.total()} kills ({what}) during {options.flights} flights, {outcome.seconds:.0f} s:")
    print(f"{outcome.lost} lost, {outcome.doubled} twice, totals {'the same' if outcome.same else 'DIFFERENT'}")
    if outcome.kills.total() < options.kills:
        print("the campaign was over before all kills; fly more or longer flights", file=sys.stderr)
        return 1
    return 0 if outcome.same and not outcome.lost and not outcome.doubled else 1


if __name__ == "__main__":
    sys.exit(main())
