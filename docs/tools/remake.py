"""Fill the tables of README.md and docs/ from JSON: `make numbers`.

What is filled stands between `<!-- NAME: filled by docs/tools/remake.py from FILE -->` and `<!-- NAME end -->`.  Golden
numbers are in the repository, under tests/golden; all other files are made by a command, under runs/.  What lacks its
file stays as it is.  Below what a command of this script made stand that command, its commit, date and solver.  What
nobody reads row by row is kept as CSV in docs/data.

    python docs/tools/remake.py                    # fill all tables from the files that are there
    python docs/tools/remake.py speed mismatch     # run the commands that make these files first
"""

from __future__ import annotations

import argparse
import csv
import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from PIL import Image

from quadsim.console.progress import reporting
from quadsim.features.campaign.statistics import interval
from quadsim.features.papers.reproduction import NUMBER_KINDS

ROOT: Final = Path(__file__).resolve().parents[2]
MADE: Final = ROOT / "runs" / "numbers"
BLOCK: Final = re.compile(r"<!-- (\S+): filled by docs/tools/remake.py from (\S+) -->\n(.*?)<!-- \1 end -->", re.DOTALL)
PYTHON, QUADSIM = sys.executable, str(Path(sys.executable).with_name("quadsim"))
CAMPAIGNS: Final = ("paper-robustness", "paper-robustness-robust", "paper-nominal")
BATTERIES: Final = {
    "battery-none": ("without an estimate", ["battery", "--set", "controller.disturbance.largest_force=1e-6"]),
    "battery": ("with a force along three axes", ["battery"]),
    "battery-thrust-scale": ("with the thrust's scale", ["battery-thrust-scale"]),
}
"""Of each campaign on a battery, what the observer estimates, and the arguments of `quadsim campaign`."""
MEMBERS: Final = {"campaigns": CAMPAIGNS, "battery": tuple(BATTERIES)}
BENCHMARKS: Final = (
    *("solvers", "flight", "nonlinear", "film", "campaign", "mismatch", "speed", "autopilots", "interfaces"),
    *("identification", "intervals", "stability", "moment", "batch"),
)
KEPT: Final = ("solvers", "speed", "interfaces", "identification")
"""Benchmarks whose figure is kept in docs/."""
FIGURES: Final = {
    "campaign-paper-nominal.png": "runs/campaigns/paper-nominal/campaign.png",
    **{f"{name}.png": f"runs/numbers/{name}.png" for name in KEPT},
}
"""Pictures of docs/, and the files that they are copies of."""
COLOURS: Final = 128
SOLVERS: Final = ("piqp-multistage", "piqp-dense", "daqp", "core", "clarabel")
"""The solvers that `make setup` installs."""
DRAWN: Final = ("drawings.py", "live_picture.py", "figures.py", "film.py", "gallery.py thumbnails")
WITHOUT_SOLVER: Final = ("film", "nonlinear", "batch")
"""Tables whose numbers come from no QP."""
LOST: Final = 2.0
"""Error over a course's size from which a vehicle counts as lost, in the table of the air's moment."""
Record = dict[str, Any]


def flown(name: str, *arguments: str) -> list[str]:
    """The command that flies a campaign, or continues it."""
    return [QUADSIM, "campaign", *arguments, "--out", f"runs/campaigns/{name}", "--resume"]


COMMANDS: Final[dict[str, list[list[str]]]] = {
    **{name: [[PYTHON, f"benchmarks/{name}.py", "--json", f"runs/numbers/{name}.json"]] for name in BENCHMARKS},
    "papers": [[QUADSIM, "reproduce", "--json"]],
    "first-flights": [[PYTHON, "tests/first_flights.py"]],
    "fastest-courses": [[PYTHON, "tests/fastest_courses.py"]],
    "campaigns": [flown(name, name) for name in CAMPAIGNS],
    "battery": [flown(name, *arguments) for name, (_, arguments) in BATTERIES.items()],
    "ppo": [[PYTHON, *["examples/ppo.py", "--json", "runs/numbers/ppo.json", "--policy", "examples/ppo_policy.json"]]],
    "pictures": [[PYTHON, *f"docs/tools/{script}".split()] for script in DRAWN],
}
"""What makes the files of a name."""
COMMANDS["solvers"][0] += ["--solvers", *SOLVERS]
PRINTED: Final = ("papers", "first-flights", "fastest-courses")
"""Names whose command prints its JSON."""


def make(name: str) -> None:
    """Run the commands of a name, and note what its numbers come from."""
    MADE.mkdir(parents=True, exist_ok=True)
    for command in COMMANDS[name]:
        with reporting(name in PRINTED or name == "pictures", name) as report:  # the others say how far they are
            report(name, 0, 1)
            stdout = subprocess.PIPE if name in PRINTED else None
            done = subprocess.run(command, cwd=ROOT, check=True, text=True, stdout=stdout)
        if stdout:
            (MADE / f"{name}.json").write_text(done.stdout, encoding="utf-8")
    git = ("git", "-C", str(ROOT))
    commit = subprocess.run([*git, "rev-parse", "--short=8", "HEAD"], check=True, text=True, capture_output=True)
    changed = subprocess.run([*git, "diff", "--quiet", "HEAD", "--", "models", "quadsim", "scenarios"])
    origin = {
        "commit": commit.stdout.strip() + (" with changes" if changed.returncode else ""),
        "date": datetime.now(UTC).date().isoformat(),
        "solver": f"PIQP {version('piqp')}",
    }
    (MADE / f"{name}.origin.json").write_text(json.dumps(origin), encoding="utf-8")


def stated_origin(name: str) -> str:
    """The line below what this script made: its command, commit, date and solver; "" for all else."""
    if not (file := MADE / f"{name}.origin.json").is_file():
        return ""
    made = json.loads(file.read_text(encoding="utf-8"))
    by = "" if name in WITHOUT_SOLVER else f", {made['solver']}"
    return f"\n*`make numbers OPTIONS={name}`, commit {made['commit']}, {made['date']}{by}.*\n"


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "".join("| " + " | ".join(map(str, line)) + " |\n" for line in lines)


def span(values: Iterable[float], form: str = ".3g") -> str:
    """The range of some numbers."""
    ordered = sorted(values)
    return f"{ordered[0]:{form}} to {ordered[-1]:{form}}"


def _bound(bound: Record, unit: str) -> str:
    if bound["satisfied"]:
        return f"holds ({bound['margin']:.3f} {unit})"
    seconds = f"{bound['time_violated']:.2f} s" if bound["time_violated"] else "only the command violates it"
    return f"violated ({bound['margin']:.2f} {unit}), {seconds}"


PAPER: Final[dict[str, Callable[[Record], str]]] = {
    "RMS error x [m]": lambda flight: f"{flight['rmse'][0]:.3f}",
    "RMS error y [m]": lambda flight: f"{flight['rmse'][1]:.3f}",
    "RMS error z [m]": lambda flight: f"{flight['rmse'][2]:.3f}",
    "RMS error yaw [deg]": lambda flight: f"{flight['rmse'][3]:.3f}",
    "roll within 5 deg": lambda flight: _bound(flight["bounds"]["roll"], "deg"),
    "pitch within 5 deg": lambda flight: _bound(flight["bounds"]["pitch"], "deg"),
    "speeds within 0 .. 250 rad/s": lambda flight: _bound(flight["bounds"]["speed"], "rad/s"),
    "steps within -10 .. 5 rad/s": lambda flight: _bound(flight["bounds"]["slew"], "rad/s"),
    "largest step commanded [rad/s]": lambda flight: f"{flight['largest_step']:.1f}",
    "total variation of the commands [rad/s]": lambda flight: f"{flight['total_variation']:.0f}",
}
"""The rows of the paper's flights, and what stands in them."""
IN_README: Final = ("RMS error x", "RMS error z", "pitch within", "speeds within", "steps within")


def paper(flights: Record, *names: str, rows: tuple[str, ...] = ("",)) -> str:
    """The paper's flights side by side, in the rows whose titles start so."""
    titles = [title for title in PAPER if title.startswith(rows)]
    return table(["", *names], [(title, *(PAPER[title](flights[name]) for name in names)) for title in titles])


def results(flights: Record) -> str:
    """The rows of the paper's flights that differ most, for the README."""
    return paper(flights, "paper-unconstrained", "paper-unconstrained-clipped", "paper-constrained", rows=IN_README)


def both_flights(flights: Record) -> str:
    """The paper's flights, and how the first tracks where rotors saturate."""
    clipped = flights["paper-unconstrained-clipped"]["rmse"]
    return f"""{paper(flights, "paper-unconstrained", "paper-constrained")}
On rotors that saturate at 250 rad/s (`paper-unconstrained-clipped`) the unconstrained controller has RMS errors of \
{clipped[2]:.3f} m in z and {clipped[3]:.3f} deg in yaw.
"""


def ablation(flights: Record) -> str:
    """The constrained controller's weights and horizon with none, one and all of its constraints."""
    titles = ("none", "tilt within 5 deg", *(title for title in PAPER if title[:5] in ("speed", "steps")), "all")
    rows = [[f"{error:.3f}" for error in flights[title.split()[0]]["rmse"]] or ["lost", "", "", ""] for title in titles]
    head = ("constraints", *(title for title in PAPER if title.startswith("RMS")))
    return table(head, [(title, *row) for title, row in zip(titles, rows, strict=True)])


def papers(reproduction: Record) -> str:
    """How many of each paper's numbers are reproduced, each kind apart."""
    lines = []
    for each in reproduction["papers"]:
        about = ", ".join(filter(None, [f"*{each['title']}*", each["authors"], each["publication"]]))
        sentence = each["sentence"]
        lines.append(f"- {about}. {sentence[0].upper()}{sentence[1:]}.\n")
    return "".join(lines)


def paper_rows(reproduction: Record) -> list[Record]:
    """Numbers of papers, a column for each kind, and ours."""
    rows = []
    for each in reproduction["papers"]:
        for number in each["numbers"]:
            row = {"paper": each["title"], **{key: number[key] for key in ("name", "unit", "role", "relation")}}
            for kind in NUMBER_KINDS:
                stated = number[kind]
                values = stated if isinstance(stated, list) else [stated]
                row[kind] = " to ".join(f"{value:g}" for value in values if value is not None)
            rows.append(row | {key: number[key] for key in ("ours", "tolerance", "within")})
    return rows


def peer_rows(checks: list[list[str]]) -> list[Record]:
    """Every check of `make peers`; those of QP solvers last."""
    shown = (check for check in checks if not check[0].endswith(": failures"))
    head = ("check", "peer", "measured", "allowed")
    return [dict(zip(head, check, strict=True)) for check in sorted(shown, key=lambda check: check[0][0] == "`")]


def peers(checks: list[list[str]]) -> str:
    """How many checks against how many peers there are, and the largest share of an allowed difference."""
    rows = peer_rows(checks)
    share = max(float(row["measured"].split()[0]) / float(row["allowed"].split()[0]) for row in rows)
    return (
        f"{len(rows)} checks against {len({row['peer'] for row in rows})} packages agree; the largest difference is "
        f"{share:.1g} of the allowed one ([peers.csv](data/peers.csv)).\n"
    )


def export(boards: list[Record]) -> str:
    """What an exported controller takes on a board, of `make firmware`."""
    counts = {"instructions: median [M]": "p50", "p99": "p99", "most after the first": "warm", "the first": "first"}
    rows = [
        [f"`{board['law']}`", board["target"], board["precision"]]
        + [f"{board[key] / 1e3:.0f}" for key in ("flash", "ram")]
        + [f"{board[key] / 1e6:.2f}" for key in counts.values()]
        for board in boards
    ]
    return table(("scenario", "target", "precision", "flash [kB]", "RAM [kB]", *counts), rows)


def first_flights(flights: list[Record]) -> str:
    """How many first scenarios of each controller satisfied everything, and the largest error."""
    laws, courses = ([*dict.fromkeys(flight[key] for flight in flights)] for key in ("law", "course"))

    def cell(law: str, course: str) -> str:
        flown = [flight for flight in flights if (flight["law"], flight["course"]) == (law, course)]
        held = sum(flight["outcome"] == "satisfied" for flight in flown)
        return f"{held} of {len(flown)}, {100.0 * max(flight['largest'] for flight in flown):.1f} %"

    return table(("controller", *courses), [(law, *(cell(law, course) for course in courses)) for law in laws])


def moment(made: Record) -> str:
    """The largest errors of first flights with the air's moment in the law's model and without, and which hold."""
    flights = made["records"]
    laws, courses, lags = ([*dict.fromkeys(flight[key] for flight in flights)] for key in ("law", "course", "lag"))

    def cell(law: str, course: str, lag: float, known: str) -> str:
        cell = {"law": law, "course": course, "lag": lag, "moment": known}
        (flown,) = [flight for flight in flights if cell.items() <= flight.items()]
        if flown["outcome"] == "lost" or flown["share"] > LOST:
            return "lost"
        error = f"{100.0 * flown['share']:.1f} %"
        return f"**{error}**" if flown["outcome"] == "satisfied" else error

    head = ["controller", "course", *(f"{1e3 * lag:.0f} ms, {known}" for lag in lags for known in ("without", "with"))]
    rows = [
        (f"`{law}`", course, *(cell(law, course, lag, known) for lag in lags for known in ("without", "with")))
        for law in laws
        for course in courses
    ]
    return table(head, rows)


def fastest_courses(found: list[Record]) -> str:
    """The fastest speed of each vehicle on each course, and the bound that stops it."""
    courses = [*dict.fromkeys(row["course"] for row in found)]

    def cell(row: Record) -> str:
        return f"{row['size']:.3g} m: {row['by_rule']:.2f} to {row['speed']:.2f} m/s, {row['stopped_by']}"

    rows = []
    for vehicle in dict.fromkeys(row["vehicle"] for row in found):
        rows.append((vehicle, *(cell(row) for row in found if row["vehicle"] == vehicle)))
    return table(("vehicle", *courses), rows)


def campaigns(summaries: Record) -> str:
    """How often flights of the shipped campaigns failed, with 95 % intervals."""
    rows = []
    for name in CAMPAIGNS:
        events = summaries[name]["events"]
        violated = events["violation"]
        share = f"{100.0 * violated['lower']:.2f} to {100.0 * violated['upper']:.2f} %"
        counts = (violated["flights"], events["failure"]["count"], events["lost"]["count"], violated["count"])
        rows.append((name, *counts, share))
    return table(("campaign", "flights", "failed", "lost", "violated or lost", "95 % interval of its share"), rows)


def batteries(summaries: Record) -> str:
    """How many flights on a battery failed by each estimate, with their largest error of height."""
    failed = []
    for name, (estimate, _) in BATTERIES.items():
        events, height = summaries[name]["events"], summaries[name]["metrics"]["max_error.z"]
        share = f"{events['failure']['count']} of {summaries[name]['flights']}"
        failed.append(f"{share} {estimate} (height off by up to {100.0 * height['max']:.0f} cm)")
    return f"Flights that fail: {', '.join(failed)}.\n"


def solvers(data: Any) -> str:
    """The 99th percentile of a step of every solver and scenario."""
    rows: dict[str, dict[str, str]] = {}
    for row in records(data):
        rows.setdefault(row["solver"], {})[f"`{row['scenario']}`, p99 [ms]"] = f"{row['p99_ms']:.3g}"
    return table(("solver", *next(iter(rows.values()))), [(solver, *times.values()) for solver, times in rows.items()])


def nonlinear(data: Any) -> str:
    """The law in C beside acados."""
    rows = records(data)
    beside = [row for row in rows if "case" in row]
    flights = [row for row in rows if "flight" in row]
    p50 = span((row["p50_ratio"] for row in beside), ".2g")
    p99 = span((row["p99_ratio"] for row in beside), ".2g")
    step = span((row["step_p50_ms"] for row in flights), ".2g")
    own = span((row["C_p50_ms"] for row in flights), ".2g")
    return (
        f"The median step of C takes {p50} times as long as that of acados, its 99th percentile {p99} times. In flight "
        f"the median of a whole step is {step} ms, that of its C {own} ms; the rest is Python.\n"
    )


def flight(data: Any) -> str:
    """How long a second of flight takes."""
    rows = sorted((row for row in records(data) if row.get("whole_ms_per_s")), key=lambda row: row["whole_ms_per_s"])
    ends = " to ".join(f"{row['whole_ms_per_s']:.0f} ms ({row['flight']})" for row in (rows[0], rows[-1]))
    bare = span((row["without_the_controller_ms_per_s"] for row in rows), ".0f")
    return f"A second of flight takes {ends}, {bare} ms of it without the controller ([flight.csv](data/flight.csv)).\n"


def batch(data: Any) -> str:
    """Environment steps per second of processor time."""
    rows = []
    for row in records(data):
        rows.append((row["environment"], row["vehicles"], f"{row['steps_per_cpu_s']:.0f}", f"{row['real_time']:.0f}"))
    return table(("environment", "vehicles", "steps per CPU-second", "times real time"), rows)


def campaign(data: Any) -> str:
    """How many flights a core flies, and what one takes."""
    rows = records(data)
    whole = span((row["per_core_hour"] for row in rows if "wall_s" in row), ".0f")
    text = f"A campaign flies {whole} flights per core-hour.\n"
    single = [row for row in rows if "processor_ms" in row]
    if not single:
        return text
    keys = ("campaign", "integrator", "flown_by", "processor_ms", "per_core_hour")
    head = ("campaign", "integrator", "flown by the", "processor time of a flight (ms)", "flights per core-hour")
    lines = [[f"{row[key]:.0f}" if isinstance(row[key], float) else row[key] for key in keys] for row in single]
    return f"{text}\n{table(head, lines)}"


def film(data: Any) -> str:
    """How long a film takes."""
    return "A frame takes {frame_ms:.0f} ms, a minute of film {s_per_minute_of_film:.0f} s.\n".format(
        **records(data)[0]
    )


def identification(data: Any) -> str:
    """How the same vehicles fly by controllers that are made from each file."""
    by = []
    for row in records(data):
        share = 100.0 * row["violated"] / row["flights"]
        between = interval(row["violated_from"], row["violated_to"])
        by.append(
            f"{share:.0f} % ({between}) of the flights by the {row['file']} file, median error {row['median_%']:.1f} %"
        )
    return f"A constraint is violated in {'; in '.join(by)}.\n"


def intervals(data: Any) -> str:
    """How many intervals that pass the gates hold the true value, in all logs and in the kind with the lowest share."""
    passed: dict[str, int] = {}
    inside: dict[str, int] = {}
    logs: dict[str, int] = {}
    for row in records(data):
        kind = row["condition"]
        passed[kind] = passed.get(kind, 0) + row["passed"]
        inside[kind] = inside.get(kind, 0) + row["inside"]
        logs[kind] = row["logs"]
    worst = min(passed, key=lambda kind: inside[kind] / passed[kind])
    every = sum(passed.values())
    holding = sum(inside.values())
    return (
        f"In {sum(logs.values())} logs {holding} of the {every} intervals that pass the gates hold the true value: "
        f"{100.0 * holding / every:.1f} %, where 95 % are promised. The lowest share is {inside[worst]} of "
        f"{passed[worst]}, in the logs of kind *{worst}*.\n"
    )


def stability(data: Any) -> str:
    """Up to where each law is stable on each vehicle."""
    rows = records(data)
    names = [*rows[0]]
    head = ["controller" if name == "law" else name for name in names]
    note = "`<` and `>`: up to the end of the range searched; `*`: no flight beyond; `core`: processor time.\n"
    return table(head, [[row.get(name, "-") for name in names] for row in rows]) + "\n" + note


def autopilots(data: Any) -> str:
    """How far Betaflight's flights are from those of the built-in autopilot."""
    rows = records(data)
    most, held = max(abs(row["difference_cm"]) for row in rows), sum(row["verdict"] == "satisfied" for row in rows)
    return f"Of {len(rows)} flights {held} are satisfied; RMS errors differ by at most {most:.2g} cm.\n"


def ppo(data: Record) -> str:
    """What a learned policy and the MPC do on the same draws, and how long the policy learned."""
    events = {"flights": "flights", "lost": "lost", "violated": "violated", "tilted": "roll or pitch violated"}
    sizes = {"error": "RMS error, m", "largest_error": "largest of a flight, m", "peak_tilt": "largest tilt, deg"}
    head = ("", *events.values(), *sizes.values())
    rows = []
    for score in data["comparison"]:
        rows.append([score["controller"], *(f"{score[number]:.3g}" for number in (*events, *sizes))])
    steps = data["curve"][-1]["steps"]
    return f"{table(head, rows)}\n{steps} steps of training took {data['seconds']:.0f} s of one core.\n"


def records(data: Any) -> list[Record]:
    """A benchmark's records, without what is no number or text."""
    lists = [data] if isinstance(data, list) else [value for value in data.values() if isinstance(value, list)]
    rows = next(value for value in lists if value and isinstance(value[0], dict))
    return [{key: value for key, value in row.items() if not isinstance(value, (dict, list))} for row in rows]


SURVIVED: Final = (
    ("end_error", "Distance from the reference at the end [m]", 0.05, 0.5),
    ("peak_tilt", "Peak roll or pitch [deg]; the bound is 5", 5.05, 15.0),
)
"""Columns of the mismatch, what they are, and the numbers beyond which a cell is shaded, and darker."""


def mismatch(data: Record) -> str:
    """What each controller survives: a table for each number, a row per condition."""
    flights = {(row["condition"], row["controller"]): row for row in data["records"]}
    conditions = list(dict.fromkeys(condition for condition, _ in flights))
    names = list(dict.fromkeys(name for _, name in flights))
    head = "".join(f"<th>{name}</th>" for name in names)
    tables = []
    for key, title, near, far in SURVIVED:
        rows = []
        for condition in conditions:
            cells = "".join(_survived(flights[condition, name], key, near, far) for name in names)
            rows.append(f"<tr><th>{condition}</th>{cells}</tr>\n")
        caption = f"<caption>{title}</caption>"
        tables.append(f'<table class="heat">{caption}\n<tr><th></th>{head}</tr>\n{"".join(rows)}</table>\n')
    return f'<div class="wide">\n{"".join(tables)}</div>\n'


def _survived(row: Record, key: str, near: float, far: float) -> str:
    """A cell of `mismatch`."""
    if row["fate"]:
        return f'<td class="lost">{row["fate"].replace(", ", "<br>")}</td>'
    value = row[key]
    if value > far:
        return f'<td class="far">{value:.2f}</td>'
    if value > near:
        return f'<td class="near">{value:.2f}</td>'
    return f"<td>{value:.2f}</td>"


CSV: Final[dict[str, Callable[[Any], list[Record]]]] = {
    **dict.fromkeys((*KEPT, "autopilots", "flight", "intervals", "mismatch", "nonlinear", "ppo", "stability"), records),
    "papers": paper_rows,
    "peers": peer_rows,
}
"""What docs/data keeps, and how its rows are read."""
TABLES: Final[dict[str, Callable[[Any], str]]] = {
    **{each.__name__: each for each in (results, ablation, papers, peers, export, campaigns, solvers, nonlinear)},
    **{each.__name__: each for each in (flight, batch, campaign, film, identification, intervals)},
    **{each.__name__: each for each in (autopilots, stability, moment)},
    "mismatch": mismatch,
    "ppo": ppo,
    "paper": both_flights,
    "first-flights": first_flights,
    "fastest-courses": fastest_courses,
    "battery": batteries,
}


def read(name: str, source: str) -> Any:
    """A file's JSON, with `*` that of each campaign, by its name; None where a file is not there."""
    paths = {each: ROOT / source.replace("*", each) for each in MEMBERS.get(name, (name,))}
    if not all(path.is_file() for path in paths.values()):
        return None
    data = {each: json.loads(path.read_text(encoding="utf-8")) for each, path in paths.items()}
    return data if "*" in source else data[name]


def filled(text: str) -> tuple[str, list[str]]:
    """A page's text with its tables filled, and the files that are not there."""
    missing = []

    def fill(block: re.Match[str]) -> str:
        name, source, _ = block.groups()
        data = read(name, source)
        if data is None:
            missing.append(source)
            return block[0]
        content = TABLES[name](data) + stated_origin(name)
        return f"<!-- {name}: filled by docs/tools/remake.py from {source} -->\n\n{content}\n<!-- {name} end -->"

    return BLOCK.sub(fill, text), missing


def write_csv(name: str, source: Path) -> None:
    """A file's records as docs/data/NAME.csv, numbers to four digits."""
    rows = [
        {key: f"{value:.4g}" if isinstance(value, float) else value for key, value in row.items()}
        for row in CSV[name](json.loads(source.read_text(encoding="utf-8")))
    ]
    with (ROOT / "docs" / "data" / f"{name}.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, [*dict.fromkeys(key for row in rows for key in row)], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def main() -> None:
    """Make what was named, then fill every page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(COMMANDS))
    chosen = parser.parse_args().names
    if unknown := sorted({*chosen} - COMMANDS.keys()):
        parser.error(f"NAME must be one of {', '.join(COMMANDS)}; got {', '.join(unknown)}")
    for name in chosen:
        make(name)
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]:
        text, missing = filled(page.read_text(encoding="utf-8"))
        page.write_text(text, encoding="utf-8")
        for file in missing:
            print(f"{page.relative_to(ROOT)}: stays as it is without {file}")
    for name in CSV:
        if (source := MADE / f"{name}.json").is_file():
            write_csv(name, source)
    for name, drawn in FIGURES.items():
        if (ROOT / drawn).is_file():
            figure = Image.open(ROOT / drawn).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
            figure.save(ROOT / "docs" / name, optimize=True)


if __name__ == "__main__":
    main()
