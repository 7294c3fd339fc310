"""The command `quadsim live`.

It flies a scenario in real time behind a page in the browser, where the vehicle can be pulled and its controller tuned;
what happened is saved as a run, and as a scenario that repeats it.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from quadsim.errors import ParameterError
from quadsim.features.arguments import Changes, File, Flag, ScenarioName, Whole

if TYPE_CHECKING:
    from quadsim.console.results import Document
else:
    Document = Any


def live(
    scenario: ScenarioName = "playground",
    /,
    *,
    against: ScenarioName | None = None,
    out: File | None = None,
    overwrite: Flag = False,
    script: File | None = None,
    port: Whole = 0,
    host: str = "127.0.0.1",
    browser: bool = True,
    video: Flag = False,
    changes: Changes = (),
    seed: Whole | None = None,
) -> Document:
    """Fly interactively in the browser: push, change every setting, save the flight as a scenario.

    Args:
        scenario: library name, or path to a TOML file; or directory of a run to continue (default: playground, which
            is made for sessions).
        against: scenario whose controller flies a second vehicle beside the first.
        out: run directory (default: runs/SCENARIO-live, or the next free name).
        overwrite: replace an earlier output, if its summary.json lists every file in the directory.
        script: TOML file of timed inputs, flown without a browser and as fast as possible.
        port: port to listen on (default: any free port).
        host: address to listen on (default: 127.0.0.1, this machine only); others only on a network that you trust.
        browser: open the browser.
        video: film the session.
        changes: replace a field of the scenario, e.g. --set controller.horizon=30; may be repeated.
        seed: replace the seed of everything random in the scenario.

    Raises:
        InputError: something is wrong with the scenario, the script, the port or the host.
        OutputError: the directory cannot be written.
        KeyboardInterrupt: it was interrupted before its first period; later, what was flown is kept.

    Examples:
        >>> import quadsim
        >>> quadsim.live("hover", port=70_000)
        Traceback (most recent call last):
        quadsim.errors.ParameterError: --port must be from 1 to 65535, or 0 for any that is free; got 70000
    """
    from quadsim.features.live.serving import fly_live
    from quadsim.rollout.reaudit import reaudit
    from quadsim.scenarios.catalogue import names_directory
    from quadsim.scenarios.loading import load_scenario

    onward = isinstance(scenario, str | Path) and names_directory(scenario)
    if onward:
        for option, given in (("--set", bool(changes)), ("--seed", seed is not None)):
            if given:
                raise ParameterError("", option, "given", "absent when a run is continued")
        scenario = reaudit(Path(str(scenario)), products=False).scenario
    flown = load_scenario(scenario, changes, seed)
    other = None
    if against is not None:
        other = load_scenario(against).controller
    place = {"port": port, "host": host, "browser": browser}
    return fly_live(flown, other, script, onward=onward, out=out, overwrite=overwrite, video=video, **place)
