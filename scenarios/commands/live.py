"""`quadsim live`."""

from __future__ import annotations

import sys
import webbrowser
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path

from quadsim.errors import ParameterError
from quadsim.outputs import reserving
from scenarios.api import load as load_scenario
from scenarios.commands import EXIT_DONE, EXIT_FAILED, console
from scenarios.commands.console import shown
from scenarios.live.guard import LOOPBACK
from scenarios.live.pacing import Pace
from scenarios.live.session import Session, read_script
from scenarios.reaudit import reaudit, stored_scenario
from scenarios.schema.controller import ControllerSpec
from scenarios.schema.scenario import Scenario
from scenarios.shipped import scenario_names


def live(options: Namespace) -> int:
    """`quadsim live`."""
    from scenarios.commands.flights import load

    run = Path(options.scenario)
    finished = run.is_dir()
    if finished and (options.settings or options.seed is not None):
        raise ParameterError("", "--set" if options.settings else "--seed", "given", "absent where a run is flown on")
    if finished:
        reaudit(run, products=False)
    scenario = stored_scenario(run) if finished else load(options.scenario, options)
    against = None if options.against is None else load(options.against, Namespace(settings=[], seed=None)).controller
    script = None if options.script is None else read_script(options.script)
    if script is None:
        from scenarios.live.page import require_server

        require_server(options.host, options.port)
    out = Path("runs") / f"{scenario.name}-live" if options.out is None else options.out
    free = options.out is None and not options.overwrite
    with reserving(out, overwrite=options.overwrite, free=free) as target:
        session = Session(scenario, against)
        replaced = options.overwrite

        def save(session: Session) -> str:
            nonlocal replaced
            session.flight().save(target, overwrite=replaced, video=options.video)
            replaced = True  # the next time it is this session's own
            return shown(target)

        try:
            try:
                if finished:  # to where it ended
                    while session.reason is None and session.k < scenario.periods:
                        session.advance()
                if script is not None:
                    for reason in session.play(script):
                        console.say(f"refused: {reason}")
                else:
                    _serve(session, options, save)
            except KeyboardInterrupt:  # what was flown is saved
                print(file=sys.stderr)
            if session.k:
                print(f"{save(session)}: {session.k * session.period:.2f} s, {session.flight().outcome}")
            return EXIT_DONE if session.reason is None else EXIT_FAILED
        finally:
            session.close()


def _serve(session: Session, options: Namespace, save: Callable[[Session], str]) -> None:
    """Show the page and fly until Ctrl-C."""
    from scenarios.live.page import Page

    if options.host not in LOOPBACK:
        console.say(
            f"listening on {options.host}: anyone on that network with the address below can fly this session; "
            "the connection is not encrypted"
        )
    pace = Pace()
    page = Page(session, pace, save=save, host=options.host, port=options.port, others=_others(session.scenario))
    try:
        print(f"Open {page.address}  (Ctrl-C ends the session and saves it)", flush=True)
        if options.browser:
            webbrowser.open(page.address)
        pace.drive(session, page)
    finally:
        page.close()


def _others(scenario: Scenario) -> dict[str, ControllerSpec]:
    """Controllers of the library that fly the same vehicle at the same period."""
    found: dict[str, ControllerSpec] = {}
    for name in scenario_names():
        other = load_scenario(name)
        same = (other.vehicle, other.control_period) == (scenario.vehicle, scenario.control_period)
        if same and other.controller not in [*found.values(), scenario.controller]:
            found[f"{other.controller.type} of {name}"] = other.controller
    return found
