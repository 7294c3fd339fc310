"""A live session from its beginning to its saved flight: by a page in a browser, or by a script."""

from __future__ import annotations

import sys
import webbrowser
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

from scenarios import console
from scenarios.app import run_directory
from scenarios.live.guard import LOOPBACK
from scenarios.live.pacing import Pace
from scenarios.live.session import Session, read_script
from scenarios.loading import load_scenario
from scenarios.results import EXIT_DONE, EXIT_FAILED, Document
from scenarios.schema.controllers import AnyController
from scenarios.schema.scenario import Scenario
from scenarios.shipped import scenario_names


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

    The other arguments are those of `scenarios.app.live`; `place` is the port, the host and the browser.

    Raises:
        InputError: something cannot be flown so, or there is nothing that serves a page.
        OutputError: the directory cannot be written.
    """
    inputs = None if script is None else read_script(script)
    if inputs is None:
        from scenarios.live.page import require_server

        require_server(place["host"], place["port"])
    with (
        run_directory(f"{scenario.name}-live", out, overwrite=overwrite) as directory,
        closing(Session(scenario, against)) as session,
    ):
        replaced = overwrite

        def save(session: Session) -> str:
            nonlocal replaced
            session.flight().save(directory, overwrite=replaced, video=video)
            replaced = True  # the next time it is this session's own
            return console.shown(directory)

        try:
            while onward and session.reason is None and session.k < scenario.periods:
                session.advance()
            if inputs is None:
                _serve(session, save, **place)
            else:
                for reason in session.play(inputs):
                    console.say(f"refused: {reason}")
        except KeyboardInterrupt:  # what was flown is saved
            print(file=sys.stderr)
        text, flown = "", session.k * session.period
        if session.k:
            text = f"{save(session)}: {flown:.2f} s, {session.flight().outcome}\n"
        status = EXIT_DONE if session.reason is None else EXIT_FAILED
        return Document(text, {"directory": str(directory), "duration": flown, "reason": session.reason}, status)


def _serve(session: Session, save: Callable[[Session], str], *, host: str, port: int, browser: bool) -> None:
    """Show the page and fly until Ctrl-C."""
    from scenarios.live.page import Page

    if host not in LOOPBACK:
        console.say(
            f"listening on {host}: anyone on that network with the address below can fly this session; "
            "the connection is not encrypted"
        )
    pace = Pace()
    page = Page(session, pace, save=save, host=host, port=port, others=_others(session.scenario))
    with closing(page):
        print(f"Open {page.address}  (Ctrl-C ends the session and saves it)", flush=True)
        if browser:
            webbrowser.open(page.address)
        pace.drive(session, page)


def _others(scenario: Scenario) -> dict[str, AnyController]:
    """Controllers of the library that fly the same vehicle at the same period."""
    found: dict[str, AnyController] = {}
    for name in scenario_names():
        other = load_scenario(name)
        same = (other.vehicle, other.control_period) == (scenario.vehicle, scenario.control_period)
        if same and other.controller not in [*found.values(), scenario.controller]:
            found[f"{other.controller.type} of {name}"] = other.controller
    return found
