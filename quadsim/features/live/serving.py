"""A live session from start to saved flight, with a page in a browser or a script."""

from __future__ import annotations

import errno
import socket
import sys
import threading
import webbrowser
from collections.abc import Callable, Sequence
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from quadsim.console import console
from quadsim.console.progress import reporting
from quadsim.console.results import EXIT_DONE, EXIT_FAILED, Document
from quadsim.errors import MissingPackageError, ParameterError
from quadsim.features.live.guard import LOOPBACK
from quadsim.features.live.inputs import read_script
from quadsim.features.live.pace import Pace
from quadsim.features.live.session import Session
from quadsim.interrupts import SignalHold
from quadsim.mpc.laws import law_name
from quadsim.outputs import run_directory
from quadsim.rollout.flown import Flight, write_run
from quadsim.scenarios.catalogue import scenario_names
from quadsim.scenarios.loading import load_scenario
from quadsim.scenarios.schema.controllers import AnyController
from quadsim.scenarios.schema.scenario import Scenario


def fly_live(
    scenario: Scenario,
    against: AnyController | None,
    script: str | Path | None,
    *,
    onward: bool,
    out: str | Path | None,
    overwrite: bool,
    video: bool,
    **place: Any,
) -> Document:
    """Fly a session and save it, whatever ended it; `onward`: from where the scenario, a finished run's, ended.

    The other arguments are those of `quadsim.features.live.commands.live`; `place` is the port, the host and the
    browser.

    Raises:
        KeyboardInterrupt: it was interrupted before its first period, and so has no flight.
    """
    inputs = None
    if script is None:
        _require_server(place["host"], place["port"])
    else:
        inputs = read_script(script)
    with (
        run_directory(f"{scenario.name}-live", out, overwrite=overwrite) as directory,
        closing(Session(scenario, against)) as session,
        SignalHold() as hold,
    ):
        saving = _Saving(directory, overwrite=overwrite, video=video)
        refused = list[str]()
        try:
            while onward and session.reason is None and session.k < scenario.periods:
                session.advance()
            if inputs is None:
                _serve(session, saving.save, **place)
            else:
                with reporting(True, "the flight") as report:
                    refused = session.play(inputs, report)
                for reason in refused:
                    console.show(f"quadsim: refused: {script}: {reason}".split("\n"), console.stderr())
        except KeyboardInterrupt:
            print(file=sys.stderr)
            if not session.k and saving.saved is None:
                raise KeyboardInterrupt(_nothing_flown(has_page=inputs is None)) from None
        finally:  # what was flown is saved, whatever ended it
            hold.flown = True
            if session.k:
                saving.save(session.flight())
        return _result(session, saving.saved, directory, refused)


def _result(session: Session, saved: Flight | None, directory: Path, refused: Sequence[str]) -> Document:
    """Return what the command prints about a session, and whether it failed: it ended early, or inputs were refused."""
    text = ""
    if saved is not None:
        outcome = next(iter(saved.shown()))
        for line in (outcome, *saved.outputs()):
            text += f"{line}\n"
    facts = {
        "directory": str(directory),
        "duration": session.k * session.period,
        "reason": session.reason,
        "refused": refused,
    }
    status = EXIT_DONE
    if session.reason is not None or refused:
        status = EXIT_FAILED
    return Document(text, facts, status)


def _nothing_flown(*, has_page: bool) -> str:
    """Return what there is of a session that was interrupted before its first period."""
    if has_page:
        return "the flight, which begins when its page is opened, had not begun: nothing is written"
    return "the flight had not begun: nothing is written"


class _Saving:
    """The run directory of a session, written anew each time that its flight is saved.

    Attributes:
        saved: the flight as it was saved last; None before.
    """

    def __init__(self, directory: Path, *, overwrite: bool, video: bool) -> None:
        self._directory = directory
        self._overwrite = overwrite
        self._products = {"video": video, "recording": None, "figures": None}
        self._lock = threading.Lock()
        self.saved: Flight | None = None

    def save(self, flight: Flight) -> str:
        """Write a flight, one at a time; return where."""
        with self._lock:
            self.saved = write_run(
                flight, self._directory, self._products, overwrite=self._overwrite, progress=True, flown=None
            )
            self._overwrite = True  # the next time it is this session's own
        return console.short_path(self._directory)


def _require_server(host: str, port: int) -> None:
    """Refuse before the flight if the page cannot be served."""
    if find_spec("viser") is None:
        raise MissingPackageError("quadsim live", "viser", extra="live")
    if not 0 <= port <= 65535:
        raise ParameterError("", "--port", port, "from 1 to 65535, or 0 for any that is free")
    family = socket.AF_INET
    if ":" in host:
        family = socket.AF_INET6
    try:
        socket.create_server((host or "?", port), family=family).close()
    except (OSError, UnicodeError) as error:
        if getattr(error, "errno", None) in (errno.EADDRINUSE, errno.EACCES):
            raise ParameterError("", "--port", port, "a port that is free") from error
        raise ParameterError("", "--host", host, "an address of this machine") from error


def _serve(session: Session, save: Callable[[Flight], str], *, host: str, port: int, browser: bool) -> None:
    """Show the page and fly until Ctrl-C."""
    from quadsim.features.live.page import Page

    if host not in LOOPBACK:
        console.say(
            f"listening on {host}: anyone on that network with the address below can fly this session; "
            "the connection is not encrypted"
        )
    others = _other_controllers(session.scenario)
    pace = Pace(waiting=True)
    with closing(Page(session, pace, save=save, host=host, port=port, others=others)) as page:
        print(f"Open {page.address}  (Ctrl-C ends the session and saves it)", flush=True)
        if browser:
            webbrowser.open(page.address)
        pace.drive(session, page)


def _other_controllers(scenario: Scenario) -> dict[str, AnyController]:
    """Return the library's controllers for the same vehicle and period, which may take over, by name."""
    known = [scenario.controller]
    others = dict[str, AnyController]()
    for name in scenario_names():
        other = load_scenario(name)
        is_alike = other.vehicle == scenario.vehicle and other.control_period == scenario.control_period
        if is_alike and other.controller not in known:
            known.append(other.controller)
            others[f"{name} ({law_name(other.controller.type)})"] = other.controller
    return others
