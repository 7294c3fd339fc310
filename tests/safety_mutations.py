"""Run and campaign directories after tampering or damage, and what every command reports of them.

Nothing may end in a traceback, whatever a file holds, and `quadsim check` must never let a false verdict pass.

What is damaged lies in a temporary folder, and nothing is written through a link: a file is made anew in its place
(`put`), and links lead to a decoy in that folder, which has to be as it was after every case.
"""

from __future__ import annotations

import contextlib
import copy
import hashlib
import io
import json
import os
import random
import shutil
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final
from unittest import mock

import pyarrow as pa
import pyarrow.parquet as pq
import tomlkit
from ordinary_user import counts_of

from quadsim.flight import rundir
from quadsim.flight.parquet import FLIGHT_FILE, HORIZON_FILE, PLANT_FILE, TIMING_FILE
from scenarios.cli import main

MANY: Final = 700
"""Below so many cases those that are let through are not drawn, which takes most of the time."""
BARE: Final = ("--no-video", "--no-recording", "--no-figures")
SHORT: Final = ("--set", "duration=0.5", "--set", "controller.horizon=4")
RACE: Final = ("run", "hover", *SHORT, *BARE, "--json")
BROKEN: Final = ("--set", "constraints.speed.upper=150.0")
"""Makes the flight violate a constraint."""
JUNK: Final[tuple[Any, ...]] = (
    None, True, False, 0, -1, 3, 1e308, -1e308, 5e-324, 10**30, 10**4000, -0.0, "", "0", "1e9", "NaN", "null", "true",
    "[red]", "[/bold]", "[link=file:///decoy]x[/link]", ":smile:", "\x1b[2J\x1b[31m", "a\nb\r\x07", "\x00",
    "\ud800", "\u202eevil", "<script>alert(1)</script>", "$\\frac$", "{}", "%s%n", "../../etc", "x" * 100_000,
    [], [None], [[]], [1, "a", None], [0.0] * 3, [0.0] * 4, {}, {"a": None}, {"": {}}, {"rmse": 3}, {"x": "y"},
)  # fmt: skip
"""What stands where something else should."""
VERDICT: Final = ("scenario", "status", "reason", "satisfied", "expected", "as_expected", "duration", "seed")
"""Entries of a summary that its verdict rests on, besides its constraints."""


@dataclass
class Tally:
    """What came of many cases."""

    cases: int = 0
    refused: int = 0
    tracebacks: int = 0
    false_verdicts: int = 0
    wrong_answers: int = 0
    failures: list[str] = field(default_factory=list)

    def to_dict(self) -> dict[str, int]:
        """The counts."""
        return {
            name: getattr(self, name) for name in ("cases", "refused", "tracebacks", "false_verdicts", "wrong_answers")
        }


@dataclass(frozen=True)
class Answer:
    """What a command did: its exit status, None where it ended by an exception, and what it printed."""

    status: int | None
    out: str
    err: str

    @property
    def is_clear(self) -> bool:
        """Whether it ended as it may: status 0, 1 or 2, a message where 2, nothing that steers a terminal."""
        if self.status not in (0, 1, 2):
            return False
        steering = any(ord(each) < 32 and each not in "\n\t" for each in self.out + self.err)
        messages = [line for line in self.err.splitlines() if line.startswith("quadsim: ")]
        return not steering and (self.status != 2 or bool(messages))


def call(*arguments: str) -> Answer:
    """One command of `quadsim`, in this process."""
    out, err = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            status = main(arguments)
    except SystemExit as leaving:
        status = leaving.code if isinstance(leaving.code, int) else 1
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        return Answer(None, out.getvalue(), err.getvalue() + traceback.format_exc())
    return Answer(status, out.getvalue(), err.getvalue())


DECOY: Final = "the user's own"
"""What stands in the file that links lead to."""


def put(path: Path, content: bytes) -> None:
    """Write a file in place of whatever has that name; of a link the link itself goes, never what it leads to."""
    path.unlink(missing_ok=True)
    with path.open("xb") as file:  # which fails on a name that is there, links too
        file.write(content)


def is_plain_file(path: Path) -> bool:
    """Whether it is a file itself: no link, pipe or folder."""
    return path.is_file() and not path.is_symlink()


def put_table(table: pa.Table, path: Path) -> None:
    """The same with a Parquet table."""
    content = io.BytesIO()
    pq.write_table(table, content)
    put(path, content.getvalue())


# --- summaries -----------------------------------------------------------------------------------------------------


def paths_in(data: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The paths of all values in nested tables and lists."""
    entries = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in entries:
        yield (*path, key)
        yield from paths_in(value, (*path, key))


def at(data: Any, path: tuple[Any, ...]) -> Any:
    """The value at a path."""
    for key in path:
        data = data[key]
    return data


def mutated_json(data: Any, rng: random.Random) -> Any:
    """The same with one to three values deleted, replaced, nudged, repeated or swapped."""
    data = copy.deepcopy(data)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        paths = list(paths_in(data))
        if not paths:
            return rng.choice(JUNK)
        path = rng.choice(paths)
        inside, key = at(data, path[:-1]), path[-1]
        old, kind = inside[key], rng.randrange(9)
        if kind == 0:
            del inside[key]
        elif kind in (1, 2):
            inside[key] = copy.deepcopy(rng.choice(JUNK))
        elif kind == 3:
            inside[key] = nudged(old, rng)
        elif kind == 4:
            inside[key] = [old] if rng.random() < 0.5 else {"value": old}
        elif kind == 5:
            inside[key] = str(old)
        elif kind == 6:
            other = rng.choice(paths)
            with contextlib.suppress(KeyError, IndexError, TypeError):
                inside[key] = copy.deepcopy(at(data, other))
        elif kind == 7 and isinstance(old, list) and old:
            inside[key] = old + old if rng.random() < 0.5 else old[: len(old) // 2]
        elif kind == 8 and isinstance(inside, dict):
            inside[rng.choice(("", "[red]", "\x1b[0m", "extra", str(key) * 50))] = inside.pop(key)
    return data


def nudged(value: Any, rng: random.Random) -> Any:
    """A value of the same type, and another."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, int | float):
        return rng.choice((value + 1, -value, value * 10, value + 1e-3, 0, value * 1e-6))
    if isinstance(value, str):
        return rng.choice((value + "x", value.upper(), value[1:], value[::-1]))
    return value


def mutated_text(content: bytes, rng: random.Random) -> bytes:
    """The same with bytes cut off, flipped, doubled, put in or replaced, or numbers that JSON does not have."""
    i, j = sorted((rng.randrange(len(content) + 1), rng.randrange(len(content) + 1)))
    kind = rng.randrange(10)
    if kind == 0:
        return content[:i]
    if kind == 1:
        return content[:i] + content[j:]
    if kind == 2:
        flipped = bytearray(content)
        for _ in range(rng.choice((1, 3, 20))):
            flipped[rng.randrange(len(flipped))] ^= 1 << rng.randrange(8)
        return bytes(flipped)
    if kind == 3:
        return content[:i] + os.urandom(0) + rng.randbytes(rng.choice((1, 8, 200))) + content[i:]
    if kind == 4:
        return content.replace(b": ", b": NaN, " if rng.random() < 0.3 else b" : ", 1)
    if kind == 5:
        lines = content.splitlines(keepends=True)
        k = rng.randrange(len(lines))
        return b"".join([*lines[: k + 1], *lines[k:]])  # one line twice: a key twice, or no comma
    if kind == 6:
        deep = rng.choice((50, 5_000, 200_000))
        return content[:i] + b"[" * deep + b"]" * deep + content[i:]
    if kind == 7:
        return content.replace(b"true", rng.choice((b"false", b"True", b"1", b"NaN", b"Infinity")), rng.choice((1, -1)))
    if kind == 8:
        return content.replace(b"0", rng.choice((b"1e400", b"9", b"-1", b"0x1", b"1" * 5000)), rng.choice((1, 3)))
    return rng.choice((b"", b"{}", b"[]", b"null", b"\xef\xbb\xbf" + content, content.decode().encode("utf-16")))


def swapped_verdict(data: dict[str, Any], rng: random.Random) -> dict[str, Any]:
    """What one who wants a run to pass would write: every verdict good, margins too."""
    data = copy.deepcopy(data)
    data["satisfied"] = True
    for entry in data["constraints"]:
        entry["satisfied"] = True
        if rng.random() < 0.7:
            margin = rng.choice((0.0, 1.0, abs(entry["worst_margin"] or 1.0)))
            entry |= {"worst_margin": margin, "worst_margin_sampled": margin, "time_violated": 0.0}
            if rng.random() < 0.5 and entry["lower"] is not None:
                entry["peak_plant"] = entry["peak_sampled"] = entry["lower"] + margin
        elif rng.random() < 0.5:
            entry |= {"upper": 1e6, "tolerance": 1e5, "required": rng.random() < 0.5}
    if rng.random() < 0.2:
        data["constraints"] = [entry for entry in data["constraints"] if rng.random() < 0.5]
    return data


def unseal(directory: Path) -> None:
    """Make a run one of an older version, without the digest of its summary."""
    path = directory / TIMING_FILE
    table = pq.read_table(path)
    put_table(table.replace_schema_metadata(None), path)
    summary = json.loads((directory / rundir.SUMMARY_FILE).read_text())
    summary["files"][TIMING_FILE] = "sha256:" + hashlib.sha256(path.read_bytes()).hexdigest()
    put(directory / rundir.SUMMARY_FILE, json.dumps(summary, indent=2).encode())


def mutate_table_of_run(directory: Path, rng: random.Random) -> str:
    """Change a table of a run, and its hash in the summary, in place.

    Returns:
        What was done.
    """
    name = rng.choice((FLIGHT_FILE, PLANT_FILE, TIMING_FILE, HORIZON_FILE))
    way = mutated_table(directory / name, rng)
    summary = json.loads((directory / rundir.SUMMARY_FILE).read_text())
    summary["files"][name] = "sha256:" + hashlib.sha256((directory / name).read_bytes()).hexdigest()
    put(directory / rundir.SUMMARY_FILE, json.dumps(summary).encode())
    return f"{way} of {name}"


def is_false(claimed: dict[str, Any], truth: dict[str, Any]) -> bool:
    """Whether a summary that passed reports a flight as better than it was."""
    if not truth["satisfied"] or any(claimed.get(key, truth[key]) != truth[key] for key in VERDICT):
        return True
    if [entry["name"] for entry in claimed["constraints"]] != [entry["name"] for entry in truth["constraints"]]:
        return True
    bounds = ("signal", "unit", "lower", "upper", "tolerance", "tolerance_sampled", "required", "start", "stop")
    for entry, true in zip(claimed["constraints"], truth["constraints"], strict=True):
        milder = (entry["worst_margin"] or 0.0) > (true["worst_margin"] or 0.0) + 1e-5
        if milder or any(entry[key] != true[key] for key in (*bounds, "satisfied")):
            return True
    return False


def measure_summaries(count: int, seed: int = 0) -> dict[str, int]:
    """Check many runs, most with a mutated `summary.json`, some with a mutated table, each before several commands.

    Returns:
        Counts of `cases`, of those `refused`, of `tracebacks`, `false_verdicts` and `wrong_answers` (no clear message).
    """
    tally, rng = Tally(), random.Random(seed)
    with tempfile.TemporaryDirectory() as folder, _away(Path(folder)) as here, _no_pictures(count):
        bases = {}
        for name, settings in (("good", ()), ("bad", BROKEN)):
            call(*RACE, *settings, "--out", name)
            shutil.copytree(name, f"{name}-old")
            unseal(here / f"{name}-old")
            bases |= {name: here / name, f"{name}-old": here / f"{name}-old"}
        for case in range(count):
            base = bases[rng.choice(list(bases))]
            truth = json.loads((base / rundir.SUMMARY_FILE).read_text())
            content = (base / rundir.SUMMARY_FILE).read_bytes()
            way = rng.random()
            if way < 0.15:
                content = b""
            elif way < 0.6:
                content = _dumped(mutated_json(truth, rng))
            elif way < 0.75:
                content = _dumped(swapped_verdict(truth, rng))
            else:
                content = mutated_text(content, rng)
            shutil.rmtree(here / "run", ignore_errors=True)
            shutil.copytree(base, here / "run")
            if content:
                put(here / "run" / rundir.SUMMARY_FILE, content)
            else:
                content = mutate_table_of_run(here / "run", rng).encode()
            tally.cases += 1
            checked = call("check", "run", "--json", "--junit", "verdicts.xml")
            tally.refused += checked.status == 2
            _judge(tally, case, "check", checked, content)
            if checked.status == 0 and is_false(json.loads(checked.out), truth):
                tally.false_verdicts += 1
                tally.failures.append(f"case {case}: check passes a false verdict: {content[:300]!r}")
            others: dict[str, tuple[str, ...]] = {
                "check": ("check", "run"),
                "video": ("video", "run"),
                "view": ("view", "run"),
                "run": ("run", "run"),
                "replay": ("replay", "run", *BARE, "--out", "again"),
                "resume": ("campaign", "run", "--resume", "--out", "run"),
                "compare": ("compare", "run", str(bases["good"]), "--out", "page"),
                "out": (*RACE, "--out", "run"),
            }
            names = ["compare"] if checked.status == 2 or rng.random() < 0.3 else []
            for name in {*names, rng.choice([name for name in others if name != "compare"])}:
                _judge(tally, case, name, call(*others[name]), content)
    for failure in tally.failures:
        print(failure, file=sys.stderr)
    return tally.to_dict()


def _dumped(data: Any) -> bytes:
    """JSON as a careless program writes it: NaN, lone surrogates and all."""
    with _long_numbers():
        return json.dumps(data, indent=2).encode()


@contextlib.contextmanager
def _long_numbers() -> Iterator[None]:
    before = sys.get_int_max_str_digits()
    sys.set_int_max_str_digits(0)
    try:
        yield
    finally:
        sys.set_int_max_str_digits(before)


# --- campaigns -----------------------------------------------------------------------------------------------------

CAMPAIGN: Final[dict[str, Any]] = {
    "name": "little",
    "scenario": "hover",
    "flights": 6,
    "failure": ["lost", "max_error.z > 0.2"],
    "set": {
        "duration": 0.5,
        "constraints": [{"name": "roll", "signal": "roll", "lower": -5.0, "upper": 5.0}],
        "controller": {"horizon": 4},
    },
    "vary": [
        {"name": "mass", "fields": ["effects.load.mass_factor"], "distribution": "uniform", "low": 0.5, "high": 1.5}
    ],
}
TABLES: Final = ("flights.parquet", "timing.parquet")
FILES: Final = ("manifest.json", "campaign.toml", "scenario.toml", "summary.json", *TABLES)


def mutated_table(path: Path, rng: random.Random) -> str:
    """Leave a Parquet file with a column gone, of another type, twice or empty, or rows gone, doubled or shuffled.

    Returns:
        What was done.
    """
    table = pq.read_table(path)
    i = rng.randrange(table.num_columns)
    name = table.column_names[i]
    values, rows = table[name].to_pylist(), table.num_rows
    kind = rng.randrange(10)
    if kind == 0:
        table = table.drop_columns([name])
    elif kind == 1:
        table = table.set_column(i, name, pa.array([str(value) for value in values]))
    elif kind == 2:
        table = table.set_column(i, name, pa.nulls(rows))
    elif kind == 3:
        table = table.set_column(i, name, pa.array([[1]] * rows))
    elif kind == 4:
        table = pa.table([*table.columns, table[name]], names=[*table.column_names, name])
    elif kind == 5:
        table = table.slice(0, rng.randrange(rows + 1))
    elif kind == 6:
        table = pa.concat_tables([table, table])
    elif kind == 7:
        order = list(range(rows))
        rng.shuffle(order)
        table = table.take(order)
    elif kind == 8:
        junk = {"double": [float("nan"), 1e308, -1e308], "int64": [-1, 2**62, 7], "string": ["[red]", "\x1b[2J", ""]}
        known = junk.get(str(table[name].type), [None])
        table = table.set_column(i, name, pa.array([rng.choice(known) for _ in values], table[name].type))
    else:
        names = [rng.choice(("[red]", "\x1b[0m", "")) if each == name else each for each in table.column_names]
        table = table.rename_columns(names)
    put_table(table, path)
    return f"table way {kind} to {name}"


def mutate_campaign(directory: Path, rng: random.Random) -> str:
    """Damage a campaign's directory in place; sometimes so that the manifest has the damaged file's hash.

    Only files that are still plain ones are read and damaged.

    Returns:
        What was done; empty where no such file is left.
    """
    plain = [name for name in FILES if is_plain_file(directory / name)]
    if not plain:
        return ""
    name, kind = rng.choice(plain), rng.randrange(8)
    path, manifest = directory / name, directory / "manifest.json"
    if kind == 0:
        path.unlink()
    elif kind == 1:
        path.unlink()
        _put_something_else(path, rng)
    elif kind == 2:
        put(path, (directory / rng.choice(plain)).read_bytes())
    elif kind == 3:
        put(path, rng.choice((b"", b"\x00" * 100, b"PAR1", b"PAR1PAR1", b"= =", b"\xff\xfe")))
    elif kind in (4, 5) and name in TABLES:
        mutated_table(path, rng)
    elif kind in (4, 5) and name.endswith(".json"):
        put(path, _dumped(mutated_json(json.loads(path.read_text()), rng)))
    else:
        put(path, mutated_text(path.read_bytes(), rng) if name not in TABLES else _flipped(path, rng))
    if rng.random() < 0.6 and name != "manifest.json" and is_plain_file(path) and is_plain_file(manifest):
        claimed = json.loads(manifest.read_text())
        claimed["files"][name] = "sha256:" + hashlib.sha256(path.read_bytes()).hexdigest()
        put(manifest, json.dumps(claimed, indent=2).encode())
    return f"{kind} of {name}"


def _flipped(path: Path, rng: random.Random) -> bytes:
    content = bytearray(path.read_bytes())
    for _ in range(rng.choice((1, 5, 50))):
        content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    return bytes(content)


def _put_something_else(path: Path, rng: random.Random) -> None:
    ways: tuple[Callable[[], object], ...] = (
        path.mkdir,
        lambda: os.mkfifo(path),
        lambda: path.symlink_to("../decoy"),
        lambda: path.symlink_to(path.name),
        lambda: path.symlink_to("nowhere"),
        lambda: path.symlink_to("scenario.toml"),
    )
    rng.choice(ways)()


def measure_campaigns(count: int, seed: int = 0) -> dict[str, int]:
    """So many damaged directories of a campaign, each before several commands.

    Returns:
        Counts, as of `measure_summaries`.
    """
    tally, rng = Tally(), random.Random(seed)
    with tempfile.TemporaryDirectory() as folder, _away(Path(folder)) as here, _no_pictures(count):
        for name in ("first", "second"):
            (here / f"{name}.toml").write_text(tomlkit.dumps({**CAMPAIGN, "name": name}), encoding="utf-8")
            call("campaign", f"{name}.toml", "--out", name, "--workers", "1", "--no-report", "--json")
        for case in range(count):
            shutil.rmtree(here / "hurt", ignore_errors=True)
            shutil.copytree("first", "hurt")
            what = mutate_campaign(here / "hurt", rng)
            if rng.random() < 0.25:
                with contextlib.suppress(
                    OSError, ValueError, KeyError, TypeError, pa.ArrowException
                ):  # of what is no file of ours now
                    what += f", {mutate_campaign(here / 'hurt', rng)}"
            tally.cases += 1
            first = call("replay", "hurt", *BARE, "--out", "again", *rng.choice(((), ("--flight", "2"))))
            tally.refused += first.status == 2
            _judge(tally, case, "replay", first, what.encode())
            others: dict[str, tuple[str, ...]] = {
                "check": ("check", "hurt"),
                "run": ("run", "hurt"),
                "view": ("view", "hurt"),
                "video": ("video", "hurt"),
                "out": (*RACE, "--out", "hurt"),
                "again": ("campaign", "first.toml", "--out", "hurt", "--workers", "1", "--no-report"),
                "file": (
                    "campaign",
                    "hurt/campaign.toml",
                    "--out",
                    "hurt",
                    "--workers",
                    "1",
                    "--no-report",
                    "--resume",
                ),
                "resume": ("campaign", "first.toml", "--out", "hurt", "--workers", "1", "--no-report", "--resume"),
            }
            if first.status == 2 or rng.random() < 0.1:
                _judge(tally, case, "compare", call("compare", "hurt", "second", "--out", "page"), what.encode())
            name = rng.choice(list(others))
            _judge(tally, case, name, call(*others[name]), what.encode())
    for failure in tally.failures:
        print(failure, file=sys.stderr)
    return tally.to_dict()


# --- both ----------------------------------------------------------------------------------------------------------


def _judge(tally: Tally, case: int, command: str, answer: Answer, given: bytes) -> None:
    decoy = Path("decoy")
    if not is_plain_file(decoy) or decoy.read_text() != DECOY:
        raise AssertionError(f"case {case}, {command}: wrote through a link; given: {given[:300]!r}")
    if answer.status is None:
        tally.tracebacks += 1
    elif not answer.is_clear:
        tally.wrong_answers += 1
    else:
        return
    failure = f"case {case}, {command}: status {answer.status}\n{answer.err[-1500:]}\ngiven: {given[:300]!r}"
    tally.failures.append(failure)


@contextlib.contextmanager
def _away(folder: Path) -> Iterator[Path]:
    before = Path.cwd()
    os.chdir(folder)
    (folder / "decoy").write_text(DECOY)
    try:
        yield folder.resolve()
    finally:
        os.chdir(before)


@contextlib.contextmanager
def _no_pictures(count: int) -> Iterator[None]:
    """Neither films nor windows, and of few cases no figures and plots: whatever gets as far has been let through."""

    def write(_: Path, path: Path, **__: object) -> None:
        put(path, b"film")

    with (
        mock.patch("quadsim.report.film.video.render_video", write),
        mock.patch("quadsim.report.recording.open_viewer"),
        contextlib.ExitStack() as stack,
    ):
        for name in ("comparison_figure", "comparison_plots") if count < MANY else ():
            stack.enter_context(mock.patch(f"quadsim.report.pages.comparison_page.{name}", return_value=[]))
        yield


def as_ordinary_user(kind: str, count: int, seed: int = 0) -> dict[str, int]:
    """`summaries` or `campaigns`, by a process that can write nowhere but in its own directory."""
    return counts_of(Path(__file__).name, kind, str(count), str(seed))


if __name__ == "__main__":
    measure = {"summaries": measure_summaries, "campaigns": measure_campaigns}[sys.argv[1]]
    print(json.dumps(measure(int(sys.argv[2]), int(sys.argv[3]))))
