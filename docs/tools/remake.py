"""Fill the tables of README.md and docs/ from JSON: `make numbers`.

A table stands between `<!-- NAME: filled by docs/tools/remake.py from FILE -->` and `<!-- NAME end -->`.  Golden
numbers are in the repository, under tests/golden; all other files are made by a command, under runs/.  A table whose
file is not there stays as it is.  What a command of this script made states its commit, its date and its solver below
the table.  What nobody reads row by row is kept as CSV in docs/data.

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
from typing import Any, Final, get_args

from PIL import Image

from scenarios.campaign.statistics import interval
from scenarios.loading import load_scenario
from scenarios.progress import reporting
from scenarios.schema.scenario import Group

ROOT: Final = Path(__file__).resolve().parents[2]
MADE: Final = ROOT / "runs" / "numbers"
BLOCK: Final = re.compile(r"<!-- (\S+): filled by docs/tools/remake.py from (\S+) -->\n(.*?)<!-- \1 end -->", re.DOTALL)
BENCHMARKS: Final = (
    *("solvers", "flight", "nonlinear", "film", "campaign", "mismatch", "speed", "autopilots", "interfaces"),
    *("identification", "intervals"),
)
KEPT: Final = ("solvers", "mismatch", "speed", "interfaces", "identification")
"""Benchmarks whose figure is kept in docs/."""
SOLVERS: Final = ("piqp-multistage", "piqp-multistage-1", "piqp-dense", "daqp", "core", "clarabel")
"""The solvers that `make setup` installs."""
CAMPAIGNS: Final = ("paper-robustness", "paper-robustness-robust", "paper-nominal")
BATTERIES: Final = {
    "battery-none": ("without an estimate", ["battery", "--set", "controller.disturbance.largest_force=1e-6"]),
    "battery": ("with a force along three axes", ["battery"]),
    "battery-thrust-scale": ("with the thrust's scale", ["battery-thrust-scale"]),
}
"""Of each campaign on a battery, what the observer estimates, and the arguments of `quadsim campaign`."""
FIGURES: Final = {
    "campaign-paper-nominal.png": "runs/campaigns/paper-nominal/campaign.png",
    **{f"{name}.png": f"runs/numbers/{name}.png" for name in KEPT},
}
"""Pictures of docs/, and the files that they are copies of."""
COLOURS: Final = 128
TOPICS: Final[dict[Group, str]] = {
    "paper": "the paper",
    "papers": "other papers",
    "courses": "courses",
    "air": "wind, drag, lag",
    "faults": "faults",
    "ground": "ground",
    "space": "obstacles",
    "sensors": "sensors",
}
"""Of each group of scenarios, its name in the table."""
FILMS: Final = (
    *("paper-constrained-lag20", "robust-lag50", "power-loop", "window", "thrown-ball", "take-off-and-landing"),
)
"""The scenarios that the library films."""
WITHOUT_SOLVER: Final = ("film", "nonlinear")
"""Tables whose numbers come from no QP."""
Row = Sequence[object]


def commands(name: str) -> list[list[str]]:
    """What makes the files of a name: a benchmark, `papers`, `first-flights`, `campaigns`, `battery`, ..."""
    python, quadsim = sys.executable, str(Path(sys.executable).with_name("quadsim"))
    match name:
        case "papers":
            return [[quadsim, "reproduce", "--json"]]
        case "first-flights":
            return [[python, "tests/first_flights.py"]]
        case "pictures":
            scripts = (
                ["drawings.py"],
                ["live_picture.py"],
                ["figures.py"],
                ["guide_figures.py"],
                ["film.py"],
                ["gallery.py", "thumbnails"],
            )
            return [[python, f"docs/tools/{script}", *rest] for script, *rest in scripts]
        case "campaigns":
            return [[quadsim, "campaign", each, "--out", f"runs/campaigns/{each}", "--resume"] for each in CAMPAIGNS]
        case "battery":
            flown = {each: arguments for each, (_, arguments) in BATTERIES.items()}
            return [
                [quadsim, "campaign", *arguments, "--out", f"runs/campaigns/{each}", "--resume"]
                for each, arguments in flown.items()
            ]
        case "solvers":
            timed = ["--json", "runs/numbers/solvers.json", "--solvers", *SOLVERS]
            return [[python, "benchmarks/solvers.py", *timed]]
        case _:
            return [[python, f"benchmarks/{name}.py", "--json", f"runs/numbers/{name}.json"]]


def make(name: str) -> None:
    """Run the commands of a name; what prints its JSON has it saved."""
    MADE.mkdir(parents=True, exist_ok=True)
    tells = name in (*BENCHMARKS, "campaigns", "battery")  # how far it is
    for command in commands(name):
        with reporting(not tells) as report:
            report(name, 0, 1)
            stdout = subprocess.PIPE if name in ("papers", "first-flights") else None
            done = subprocess.run(command, cwd=ROOT, check=True, text=True, stdout=stdout)
        if stdout:
            (MADE / f"{name}.json").write_text(done.stdout, encoding="utf-8")
    _origin_file(name).write_text(json.dumps(origin()), encoding="utf-8")


def origin() -> dict[str, str]:
    """What numbers that are made now come from: the commit, the date, and the solver of what names no other."""
    git = ("git", "-C", str(ROOT))
    commit = subprocess.run([*git, "rev-parse", "--short=8", "HEAD"], check=True, text=True, capture_output=True)
    changed = subprocess.run([*git, "diff", "--quiet", "HEAD", "--", "models", "quadsim", "mpc", "scenarios"])
    return {
        "commit": commit.stdout.strip() + (" with changes" if changed.returncode else ""),
        "date": datetime.now(UTC).date().isoformat(),
        "solver": f"PIQP {version('piqp')}",
    }


def _origin_file(name: str) -> Path:
    return MADE / f"{name}.origin.json"


def stated_origin(name: str) -> str:
    """The line below a table that this script made: its command, commit, date and solver; "" for other tables."""
    if not (file := _origin_file(name)).is_file():
        return ""
    made = json.loads(file.read_text(encoding="utf-8"))
    by = "" if name in WITHOUT_SOLVER else f"; QPs by {made['solver']} where no other solver is named"
    return f"\n*`make numbers OPTIONS={name}`, commit {made['commit']}, {made['date']}{by}.*\n"


def markdown(head: Sequence[str], rows: Iterable[Row]) -> str:
    """A Markdown table."""
    lines = [[str(cell) for cell in row] for row in rows]
    return "".join("| " + " | ".join(line) + " |\n" for line in [head, ["---"] * len(head), *lines])


def results(flights: dict[str, Any]) -> str:
    """The rows of `paper` by which the flights differ most, for the README."""
    head, rule, *rows = paper(flights).splitlines(keepends=True)
    chosen = ("RMS error x", "RMS error z", "pitch within", "speeds within", "steps within")
    return "".join([head, rule, *(row for row in rows if row.removeprefix("| ").startswith(chosen))])


def paper(flights: dict[str, Any]) -> str:
    """The paper's flights side by side."""
    names = ("paper-unconstrained", "paper-unconstrained-clipped", "paper-constrained")
    every = [flights[name] for name in names]
    rows: list[Row] = [
        (f"RMS error {axis} [{'deg' if axis == 'yaw' else 'm'}]", *(f"{flight['rmse'][i]:.3f}" for flight in every))
        for i, axis in enumerate(("x", "y", "z", "yaw"))
    ]
    rows.append(("largest error at the end [m, rad]", *(f"{flight['final_error']:.0e}" for flight in every)))
    for name, title, unit in (
        ("roll", "roll within 5 deg", "deg"),
        ("pitch", "pitch within 5 deg", "deg"),
        ("speed", "speeds within 0 .. 250 rad/s", "rad/s"),
        ("slew", "steps within -10 .. 5 rad/s", "rad/s"),
    ):
        rows.append((title, *(_bound(flight["bounds"][name], unit) for flight in every)))
    rows.append(("highest rotor speed acting [rad/s]", *(f"{flight['highest_speed']:.1f}" for flight in every)))
    rows.append(("largest step commanded [rad/s]", *(f"{flight['largest_step']:.1f}" for flight in every)))
    rows.append(("total variation of the commands [rad/s]", *(f"{flight['total_variation']:.0f}" for flight in every)))
    rows.append(("optimum found in", *(f"{flight['optima']} of {flight['periods']} periods" for flight in every)))
    return markdown(("", *names), rows)


def ablation(flights: dict[str, Any]) -> str:
    """The constrained controller's weights and horizon with none, one and all of its constraints."""
    titles = {
        "none": "none",
        "tilt": "tilt within 5 deg",
        "speeds": "speeds within 0 .. 250 rad/s",
        "steps": "steps within -10 .. 5 rad/s",
        "all": "all",
    }
    head = ("constraints", *(f"RMS error {axis}" for axis in ("x [m]", "y [m]", "z [m]", "yaw [deg]")))
    rows: list[Row] = []
    for name, title in titles.items():
        errors = [f"{error:.3f}" for error in flights[name]["rmse"]] or ["lost", "", "", ""]
        rows.append((title, *errors))
    return markdown(head, rows)


def _bound(found: dict[str, Any], unit: str) -> str:
    margin, seconds = found["margin"], found["time_violated"]
    if found["satisfied"]:
        return f"holds ({margin:.3f} {unit})"
    return f"violated ({margin:.2f} {unit}), {f'{seconds:.2f} s' if seconds else 'by commands alone'}"


def scenarios(golden: dict[str, Any]) -> str:
    """The library: one table, and films."""
    specs = {name: load_scenario(name) for name in golden}
    rows = [
        (
            f"![{name}](assets/gallery/{name}.svg){{loading=lazy}} {_title(name)} {specs[name].description}",
            TOPICS[group],
            golden[name]["verdict"],
        )
        for group in get_args(Group)
        for name in golden
        if specs[name].group == group
    ]
    films = "".join(_film(name) for name in golden if name in FILMS)
    table = markdown(("scenario", "topic", "verdict"), rows)
    return f'<div class="library" markdown>\n\n{table}\n</div>\n\n<div class="films">\n{films}</div>\n'


def _title(name: str) -> str:
    """A scenario's name, which opens its file."""
    return f'<a href="scenarios/{name}.txt"><code>{name}</code></a>'


def _film(name: str) -> str:
    """A film under a poster; assets/library.js gives it its controls."""
    video = f'<video src="films/{name}.mp4" poster="assets/gallery/{name}.jpg" preload="none"></video>'
    return f"<figure>{video}<figcaption>{_title(name)}</figcaption></figure>\n"


def papers(reproduction: dict[str, Any]) -> str:
    """How many of each paper's numbers are reproduced."""
    rows = []
    for paper in reproduction["papers"]:
        within = sum(number["within"] for number in paper["numbers"])
        about = ", ".join(filter(None, [paper["title"], paper["authors"], paper["publication"]]))
        rows.append((about, f"{within} of {len(paper['numbers'])}"))
    return markdown(("paper", "numbers reproduced"), rows)


def paper_rows(reproduction: dict[str, Any]) -> list[dict[str, Any]]:
    """Published numbers and ours."""
    rows = []
    for paper in reproduction["papers"]:
        for number in paper["numbers"]:
            span = number["published"] if isinstance(number["published"], list) else [number["published"]]
            published = " to ".join(f"{value:g}" for value in sorted({*span}))
            row = {"paper": paper["title"], **{key: number[key] for key in ("name", "unit", "relation")}}
            rows.append(row | {"published": published} | {key: number[key] for key in ("ours", "tolerance", "within")})
    return rows


def peer_rows(checks: list[list[str]]) -> list[dict[str, Any]]:
    """Every check of `make peers`; those of QP solvers last."""
    shown = (check for check in checks if not check[0].endswith(": failures"))
    head = ("check", "peer", "measured", "allowed")
    return [dict(zip(head, check, strict=True)) for check in sorted(shown, key=lambda check: check[0][0] == "`")]


def peers(checks: list[list[str]]) -> str:
    """Of each peer, its checks, and the largest difference as a share of the allowed one."""
    rows: dict[str, list[float]] = {}
    for check in peer_rows(checks):
        measured, allowed = (float(check[key].split()[0]) for key in ("measured", "allowed"))
        rows.setdefault(check["peer"], []).append(measured / allowed)
    head = ("peer", "checks", "largest difference over the allowed one")
    return markdown(head, [(peer, len(shares), f"{max(shares):.1g}") for peer, shares in sorted(rows.items())])


def export(boards: list[dict[str, Any]]) -> str:
    """What an exported controller takes on a board, of `make firmware`."""
    rows = [
        (
            *(
                f"`{board['law']}`",
                board["target"],
                board["precision"],
                f"{board['flash'] / 1e3:.0f}",
                f"{board['ram'] / 1e3:.0f}",
            ),
            *(f"{board[name] / 1e6:.2f}" for name in ("p50", "p99", "warm", "first")),
        )
        for board in boards
    ]
    instructions = ("instructions: median [M]", "p99", "most after the first", "the first")
    return markdown(("scenario", "target", "precision", "flash [kB]", "RAM [kB]", *instructions), rows)


def first_flights(flights: list[dict[str, Any]]) -> str:
    """How many first scenarios of each controller satisfied everything, and what the others failed."""
    courses = [*dict.fromkeys(flight["course"] for flight in flights)]
    rows = []
    for law in dict.fromkeys(flight["law"] for flight in flights):
        cells = []
        for course in courses:
            flown = [flight for flight in flights if (flight["law"], flight["course"]) == (law, course)]
            held = sum(flight["outcome"] == "satisfied" for flight in flown)
            cells.append(f"{held} of {len(flown)}, {100.0 * max(flight['largest'] for flight in flown):.1f} %")
        rows.append((law, *cells))
    return markdown(("controller", *courses), rows)


def campaigns(summaries: dict[str, Any]) -> str:
    """How often flights of the shipped campaigns failed, with 95 % intervals."""
    rows = []
    for name in CAMPAIGNS:
        events = summaries[name]["events"]
        violated = events["violation"]
        interval = f"{100.0 * violated['lower']:.2f} to {100.0 * violated['upper']:.2f} %"
        counts = (violated["flights"], events["failure"]["count"], events["lost"]["count"], violated["count"])
        rows.append((name, *counts, interval))
    return markdown(("campaign", "flights", "failed", "lost", "violated or lost", "95 % interval of its share"), rows)


def batteries(summaries: dict[str, Any]) -> str:
    """How many flights on a battery failed by each estimate, with their largest error of height."""
    failed = []
    for name, (estimate, _) in BATTERIES.items():
        events, height = summaries[name]["events"], summaries[name]["metrics"]["max_error.z"]
        share = f"{events['failure']['count']} of {summaries[name]['flights']}"
        failed.append(f"{share} {estimate} (height off by up to {100.0 * height['max']:.0f} cm)")
    return f"Flights that fail: {', '.join(failed)}.\n"


def solvers(data: Any) -> str:
    """Step times of every solver, and how the 99th percentile compares with that of the scenario's first."""
    rows, first = [], {row["scenario"]: row for row in reversed(_records(data))}
    for row in _records(data):
        times = (f"{row[key]:.3g}" for key in ("p50_ms", "p99_ms"))
        rows.append((row["scenario"], row["solver"], *times, f"{row['p99_ms'] / first[row['scenario']]['p99_ms']:.2f}"))
    return markdown(("scenario", "solver", "p50 [ms]", "p99 [ms]", "p99, ratio"), rows)


def nonlinear(data: Any) -> str:
    """The law in C beside acados."""
    keys = ("case", "C_p50_ms", "C_p99_ms", "p50_ratio", "p99_ratio")
    rows = [[_cell(row[key]) for key in keys] for row in _records(data) if "case" in row]
    return markdown([key.replace("_", " ") for key in keys], rows)


def film(data: Any) -> str:
    """How long a film takes."""
    (row,) = _records(data)
    return f"A frame takes {row['frame_ms']:.0f} ms, a minute of film {row['s_per_minute_of_film']:.0f} s.\n"


def identification(data: Any) -> str:
    """How the same vehicles fly by controllers that are made from each file."""
    by = []
    for row in _records(data):
        share = 100.0 * row["violated"] / row["flights"]
        span = interval(row["violated_from"], row["violated_to"])
        by.append(
            f"{share:.0f} % ({span}) of the flights by the {row['file']} file, median error {row['median_%']:.1f} %"
        )
    return f"A constraint is violated in {'; in '.join(by)}.\n"


def autopilots(data: Any) -> str:
    """How far Betaflight's flights are from those of the built-in autopilot."""
    rows = _records(data)
    most, held = max(abs(row["difference_cm"]) for row in rows), sum(row["verdict"] == "satisfied" for row in rows)
    return f"Of {len(rows)} flights {held} are satisfied; RMS errors differ by at most {most:.2g} cm.\n"


def records(data: Any) -> str:
    """A benchmark's records, one a row, under their keys."""
    rows = _records(data)
    keys = [*dict.fromkeys(key for row in rows for key in row)]
    return markdown([key.replace("_", " ") for key in keys], [[_cell(row.get(key)) for key in keys] for row in rows])


def _records(data: Any) -> list[dict[str, Any]]:
    lists = [data] if isinstance(data, list) else [value for value in data.values() if isinstance(value, list)]
    found: list[dict[str, Any]] = next(value for value in lists if value and isinstance(value[0], dict))
    return [{key: value for key, value in row.items() if not isinstance(value, (dict, list))} for row in found]


def _cell(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.3g}"
    return "-" if value is None else str(value)


def write_csv(name: str, rows_of: Callable[[Any], list[dict[str, Any]]]) -> None:
    """What a name's file holds as docs/data/NAME.csv, numbers to four digits."""
    source = MADE / f"{name}.json"
    if not source.is_file():
        return
    rows = [
        {key: f"{value:.4g}" if isinstance(value, float) else value for key, value in row.items()}
        for row in rows_of(json.loads(source.read_text(encoding="utf-8")))
    ]
    with (ROOT / "docs" / "data" / f"{name}.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, [*dict.fromkeys(key for row in rows for key in row)], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


CSV: Final[dict[str, Callable[[Any], list[dict[str, Any]]]]] = {
    **dict.fromkeys((*KEPT, "autopilots", "intervals", "nonlinear"), _records),
    "papers": paper_rows,
    "peers": peer_rows,
}
"""What docs/data keeps, and how its rows are read."""
TABLES: Final[dict[str, Callable[[Any], str]]] = {
    "results": results,
    "paper": paper,
    "ablation": ablation,
    "scenarios": scenarios,
    "papers": papers,
    "peers": peers,
    "export": export,
    "first-flights": first_flights,
    "campaigns": campaigns,
    "battery": batteries,
    "solvers": solvers,
    "identification": identification,
    "nonlinear": nonlinear,
    "film": film,
    "autopilots": autopilots,
    **dict.fromkeys(("flight", "campaign"), records),
}


def read(name: str, source: str) -> Any:
    """A file's JSON, with `*` that of each campaign, by its name; None where a file is not there."""
    members = {"campaigns": CAMPAIGNS, "battery": tuple(BATTERIES)}.get(name, (name,))
    paths = {each: ROOT / source.replace("*", each) for each in members}
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
        table = TABLES[name](data) + stated_origin(name)
        return f"<!-- {name}: filled by docs/tools/remake.py from {source} -->\n\n{table}\n<!-- {name} end -->"

    return BLOCK.sub(fill, text), missing


def main() -> None:
    """Make what was named, then fill every page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = [*BENCHMARKS, "papers", "first-flights", "campaigns", "battery", "pictures"]
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(names))
    chosen = parser.parse_args().names
    if unknown := sorted({*chosen} - {*names}):
        parser.error(f"NAME must be one of {', '.join(names)}; got {', '.join(unknown)}")
    for name in chosen:
        make(name)
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]:
        text, missing = filled(page.read_text(encoding="utf-8"))
        page.write_text(text, encoding="utf-8")
        for source in missing:
            print(f"{page.relative_to(ROOT)}: stays as it is without {source}")
    for name, rows_of in CSV.items():
        write_csv(name, rows_of)
    for name, drawn in FIGURES.items():
        if (ROOT / drawn).is_file():
            figure = Image.open(ROOT / drawn).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
            figure.save(ROOT / "docs" / name, optimize=True)


if __name__ == "__main__":
    main()
