"""The `quadsim` command: parses the line, runs one command, turns errors into messages and exit statuses.

Exit status: 0 done; 1 a required constraint does not hold, or the flight was aborted or interrupted; 2 the input was
wrong.  Nothing heavy is imported before a command runs, so that `quadsim --help` answers at once.
"""

from __future__ import annotations

import argparse
import contextlib
import logging
import os
import re
import sys
from collections.abc import Iterator, Sequence
from typing import Any, Final, NoReturn

from quadsim import __version__
from quadsim.errors import QuadsimError, printable
from scenarios.commands import EXIT_FAILED, EXIT_WRONG_INPUT, find_command

_MOST_LINES, _LONGEST_LINE = 21, 1000  # of a message: one with many problems has a line for each
_SCENARIO: Final = "library name, or path to a TOML file"
_NUMBER: Final[dict[str, Any]] = {"type": int, "metavar": "N"}
_OVERWRITE: Final[dict[str, Any]] = {
    "action": "store_true",
    "help": "replace an earlier output there, if its summary.json lists all that the directory holds",
}
_SUMMARY: Final[dict[str, Any]] = {"action": "store_true", "help": "print the summary alone, as JSON on stdout"}


class _Parser(argparse.ArgumentParser):
    """Shows what it was given as text, whatever stands in it."""

    def error(self, message: str) -> NoReturn:
        """See `argparse.ArgumentParser.error`."""
        super().error(_shown(message))


def make_parser() -> argparse.ArgumentParser:
    """The command line's grammar."""
    parser = _Parser(
        prog="quadsim",
        description="Fly model predictive controllers of quadrotors in MuJoCo; record, film and audit every flight.",
        epilog="exit status: 0 done; 1 a required constraint does not hold, or the flight was aborted or interrupted; "
        "2 wrong input",
    )
    parser.add_argument("--version", action="version", version=f"quadsim {__version__}")
    command = parser.add_subparsers(dest="command", metavar="COMMAND", required=True).add_parser

    listing = command("list", help="scenarios, vehicles, controllers and solvers, one line each")
    listing.add_argument("--json", action="store_true", help="as JSON on stdout")

    run = command("run", help="fly one scenario and write its run directory")
    run.add_argument("scenario", metavar="SCENARIO", help=_SCENARIO)
    run.add_argument("--out", metavar="DIR", help="run directory (default: runs/SCENARIO, or the next free name)")
    run.add_argument("--overwrite", **_OVERWRITE)
    _add_settings(run)
    _add_products(run)
    run.add_argument("--json", **_SUMMARY)

    integrity = (
        "Audit a scenario, which is flown first, or a finished run again from its tables: integrity, not authenticity."
    )
    check = command(
        "check", help="audit a scenario (flown first) or a finished run; exit 1 if it fails", description=integrity
    )
    check.add_argument("target", metavar="SCENARIO_OR_RUN", help="library name, TOML file, or run directory")
    _add_settings(check)
    check.add_argument("--junit", metavar="FILE", help="also write the verdicts as JUnit XML")
    check.add_argument("--json", **_SUMMARY)

    compare = command("compare", help="flights, or two campaigns, side by side: table, figures, HTML page")
    targets = "run directories, scenarios to fly, or the directories of two campaigns"
    compare.add_argument("targets", metavar="RUN_OR_SCENARIO", nargs="+", help=targets)
    compare.add_argument("--out", metavar="DIR", required=True, help="directory of the page")
    compare.add_argument("--overwrite", **_OVERWRITE)
    compare.add_argument("--markdown", action="store_true", help="print the table as Markdown")

    _add_live(command("live", help="fly in the browser: push, turn every knob, keep it as a scenario"))

    video = command("video", help="film a finished run")
    video.add_argument("run", metavar="RUN", help="run directory")
    video.add_argument("--out", metavar="FILE", help="MP4 or GIF file (default: RUN/flight.mp4)")
    video.add_argument("--overwrite", action="store_true", help="replace a file that is there")
    video.add_argument("--workers", **_NUMBER, help="rendering processes (default: one per core)")

    view = command("view", help="open a run's recording in the rerun viewer")
    view.add_argument("run", metavar="RUN", help="run directory or .rrd file")
    view.add_argument("--web", action="store_true", help="serve the viewer to a browser instead")

    scenario = command("scenario", help="print a scenario with all defaults and comments: a start for yours")
    scenario.add_argument("scenario", metavar="SCENARIO", nargs="?", help=_SCENARIO)
    _add_settings(scenario)
    scenario.add_argument("--for", dest="vehicle", metavar="VEHICLE", help="print one made for this vehicle instead")
    scenario.add_argument("--course", metavar="NAME", help="of it: hover, step or figure-eight (default: hover)")
    scenario.add_argument("--controller", metavar="NAME", help="of it: robust, lqr, pid or geometric (default: robust)")
    scenario.add_argument("--schema", action="store_true", help="print the JSON Schema of scenario files instead")

    vehicle = command("vehicle", help="a vehicle's derived figures, its parameters' sources, its picture")
    vehicle.add_argument(
        "vehicle", metavar="VEHICLE", nargs="?", help="a shipped vehicle's name, or path to a TOML file"
    )
    vehicle.add_argument("--template", action="store_true", help="print a commented vehicle file to fill in instead")
    vehicle.add_argument("--scenario", metavar="SCENARIO", help="report which of its bounds the vehicle cannot meet")
    vehicle.add_argument("--out", metavar="FILE", help="PNG file to draw it to, on a floor of 10 cm squares")
    vehicle.add_argument("--overwrite", action="store_true", help="replace a file that is there")
    vehicle.add_argument("--json", action="store_true", help="as JSON on stdout")

    _add_campaign(command("campaign", help="fly a scenario many times, what may vary drawn at random"))

    replay = command("replay", help="fly one flight of a campaign again, with all outputs")
    replay.add_argument("campaign", metavar="CAMPAIGN", help="a campaign's directory")
    which = replay.add_mutually_exclusive_group()
    which.add_argument("--worst", action="store_true", help="the worst flight (the default)")
    which.add_argument("--flight", **_NUMBER, help="that flight")
    replay.add_argument("--out", metavar="DIR", help="run directory (default: runs/CAMPAIGN-N, or the next free name)")
    replay.add_argument("--overwrite", **_OVERWRITE)
    _add_products(replay)
    replay.add_argument("--json", **_SUMMARY)

    reproduce = command("reproduce", help="fly what papers publish: published, ours, difference; exit 1 if one is off")
    reproduce.add_argument("paper", metavar="PAPER", nargs="?", help="name, or path to a TOML file (default: all)")
    reproduce.add_argument("--junit", metavar="FILE", help="also write each number's verdict as JUnit XML")
    reproduce.add_argument("--json", action="store_true", help="as JSON on stdout")

    export = command("export", help="write a scenario's controller as self-contained C99, with its recorded periods")
    export.add_argument("scenario", metavar="SCENARIO", help=_SCENARIO)
    export.add_argument("--out", metavar="DIR", required=True, help="directory")
    export.add_argument("--overwrite", **_OVERWRITE)
    export.add_argument("--precision", default="double", help="of all numbers: double or float (default: double)")
    machine = "what its programs are for: posix, cortex-m7 or cortex-m4f (default: posix)"
    export.add_argument("--target", metavar="NAME", default="posix", help=machine)
    rows = "room for so many active rows; memory grows with the square (default: 2.56 per step, at least 64)"
    export.add_argument("--rows", **_NUMBER, help=rows)
    fly = "then fly the scenario with the exported controller on its target, emulated, into runs/SCENARIO-NAME"
    export.add_argument("--fly", action="store_true", help=fly)
    _add_settings(export)

    _add_tune(command("tune", help="search fields of a scenario; the answer is held against the start on fresh draws"))

    doctor = command("doctor", help="what this machine can do")
    doctor.add_argument("--json", action="store_true", help="as JSON on stdout")
    return parser


def _add_live(live: argparse.ArgumentParser) -> None:
    add = live.add_argument
    add("scenario", metavar="SCENARIO_OR_RUN", help=f"{_SCENARIO}, or the directory of a run to fly on from")
    add("--against", metavar="SCENARIO", help="a second vehicle, flown by the controller of this scenario")
    add("--out", metavar="DIR", help="run directory (default: runs/SCENARIO-live, or the next free name)")
    add("--overwrite", **_OVERWRITE)
    add("--script", metavar="FILE", help="TOML file of inputs and times: no browser, as fast as it goes")
    add("--port", **_NUMBER, default=0, help="to listen on (default: any free one)")
    add("--host", metavar="ADDRESS", default="127.0.0.1", help="other than this machine: for a network that you trust")
    add("--browser", action=argparse.BooleanOptionalAction, default=True, help="open the browser")
    add("--video", action=argparse.BooleanOptionalAction, default=False, help="film what was flown")
    _add_settings(live)


def _add_campaign(campaign: argparse.ArgumentParser) -> None:
    add = campaign.add_argument
    add("file", metavar="FILE", help=_SCENARIO)
    add("--out", metavar="DIR", help="campaign's directory (default: runs/campaigns/NAME)")
    add("--overwrite", **_OVERWRITE)
    add("--workers", **_NUMBER, help="processes (default: one per core)")
    add("--cluster", metavar="ADDRESS", help="fly on a Dask cluster: its scheduler's address, tcp://HOST:PORT")
    add("--resume", action="store_true", help="continue what is there")
    add("--flights", **_NUMBER, help="number of flights, instead of the file's")
    width = "stop once the 95 %% interval of the failure probability is as narrow as this, e.g. 0.05"
    add("--until-width", type=float, metavar="W", help=width)
    require = 'exit 1 unless the flights support it, e.g. "P(violation) < 0.01 @ 95%%"; may be repeated'
    add("--require", dest="requirements", metavar="REQUIREMENT", action="append", default=[], help=require)
    add("--report", action=argparse.BooleanOptionalAction, default=True, help="write the report, an HTML page")
    add("--junit", metavar="FILE", help="also write the requirements' verdicts as JUnit XML")
    _add_settings(campaign)
    add("--json", **_SUMMARY)


def _add_tune(tune: argparse.ArgumentParser) -> None:
    add = tune.add_argument
    add("file", metavar="FILE", help="name of a tuning that ships, or path to a TOML file")
    add("--out", metavar="DIR", help="tuning's directory (default: runs/tunings/NAME)")
    add("--overwrite", **_OVERWRITE)
    add("--trials", **_NUMBER, help="number of candidates, instead of the file's")
    add("--seed", **_NUMBER, help="replace the seed, of the search and of its draws")
    add("--workers", **_NUMBER, help="processes (default: one per core)")
    add("--cluster", metavar="ADDRESS", help="fly on a Dask cluster, as quadsim campaign does")
    add("--resume", action="store_true", help="continue what is there")
    add("--report", action=argparse.BooleanOptionalAction, default=True, help="write the report, HTML pages")
    add("--json", **_SUMMARY)


def _add_products(parser: argparse.ArgumentParser) -> None:
    for name in ("video", "recording", "figures"):
        parser.add_argument(
            f"--{name}", action=argparse.BooleanOptionalAction, help=f"make the {name} (default: where possible)"
        )


def _add_settings(parser: argparse.ArgumentParser) -> None:
    add, replaced = (
        parser.add_argument,
        "replace a field of the scenario, e.g. --set controller.horizon=30; may be repeated",
    )
    add("--set", dest="settings", metavar="KEY=VALUE", action="append", default=[], help=replaced)
    parser.add_argument("--seed", **_NUMBER, help="replace the seed, of everything random in it")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    options = _parse(sys.argv[1:] if arguments is None else arguments)
    try:
        with _notices():
            status = find_command(options.command)(options)
        sys.stdout.flush()
        return status
    except QuadsimError as error:
        print(f"quadsim: {_shown(str(error))}", file=sys.stderr)
        return error.exit_status
    except SystemExit as error:  # of code that was imported: a flight would have ended by it as aborted
        if isinstance(error.__context__, BrokenPipeError):  # rich's way to end
            return EXIT_FAILED
        print(f"quadsim: code that was loaded asks Python to exit (status {error.code!r:.80})", file=sys.stderr)
        return EXIT_WRONG_INPUT
    except KeyboardInterrupt:
        print("quadsim: interrupted (Ctrl-C); nothing half written was left behind", file=sys.stderr)
        return EXIT_FAILED
    except BrokenPipeError:  # the reader of our output went away, e.g. `quadsim check RUN | head`: no verdict was read
        _silence_stdout()
        return EXIT_FAILED
    except OSError as error:  # ours are QuadsimErrors: this one is stdout's
        print(f"quadsim: cannot write the output: {error.strerror or error}", file=sys.stderr)
        _silence_stdout()
        return EXIT_WRONG_INPUT


def _parse(arguments: Sequence[str]) -> argparse.Namespace:
    """The options of a command line, `~` in paths expanded as a shell does for words, but not for `--out=~/x`."""
    parser = make_parser()
    home = re.compile(r"(--[\w-]+=)?(~.*)", re.DOTALL)
    words = [
        (match[1] or "") + os.path.expanduser(match[2]) if (match := home.fullmatch(word)) else word  # noqa: PTH111
        for word in arguments
    ]
    for word in words:
        if re.fullmatch(r"--[\w-]+=--", word):  # of which argparse makes an empty list
            parser.error(f"argument {word[:-3]}: expected a value; got '--'")
    options = parser.parse_args(words)
    for name in ("out", "junit"):
        if (getattr(options, name, None) or "").startswith("-"):
            given = getattr(options, name)
            parser.error(
                f"argument --{name}: must be a path; got {given!r}, to be written as ./{given} if that is meant"
            )
    return options


def _shown(message: str) -> str:
    """A message as a terminal takes it, of some twenty lines at most."""
    lines = printable(message, keep="\n").split("\n")
    shown = [line if len(line) <= _LONGEST_LINE else f"{line[:_LONGEST_LINE]} ..." for line in lines[:_MOST_LINES]]
    return "\n".join([*shown, *([f"... and {len(lines) - _MOST_LINES} more"] if len(lines) > _MOST_LINES else [])])


@contextlib.contextmanager
def _notices() -> Iterator[None]:
    """Show the program's notices on stderr: which code of the user's was imported."""
    logger, handler = logging.getLogger("quadsim"), _NoticeHandler()
    before = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)


class _NoticeHandler(logging.Handler):
    """Shows the program's notices on stderr, each once."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self._shown: set[str] = set()

    def emit(self, record: logging.LogRecord) -> None:
        """See `logging.Handler.emit`."""
        text = record.getMessage()
        if text not in self._shown:
            self._shown.add(text)
            print(f"quadsim: {printable(text)}", file=sys.stderr, flush=True)


def _silence_stdout() -> None:
    """Send the rest of stdout nowhere, so that Python does not fail on it at its exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    from scenarios.entry import main as start

    sys.exit(start())
