"""The command `quadsim export`.

It writes a scenario's controller as self-contained C99: the files that fly in simulation (`quadsim/mpc/c`), this
controller's numbers, and recorded periods to check them by.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any, Final

from quadsim.features.arguments import Changes, File, Flag, ScenarioName, Watched, Whole

if TYPE_CHECKING:
    from quadsim.console.results import Document
    from quadsim.rollout.flown import Flight
else:
    Document = Flight = Any

_log: Final = logging.getLogger("quadsim")


def export(
    scenario: ScenarioName,
    /,
    *,
    out: File,
    overwrite: Flag = False,
    precision: str = "double",
    target: str = "posix",
    rows: Whole | None = None,
    fly: Flag = False,
    changes: Changes = (),
    seed: Whole | None = None,
    progress: Watched = True,
) -> Document | Flight:
    """Export a scenario's controller as self-contained C99, with recorded periods to test it.

    Args:
        scenario: library name, or path to a TOML file.
        out: output directory.
        overwrite: replace an earlier output, if its summary.json lists every file in the directory.
        precision: number type, double or float (default: double).
        target: platform of the test programs: posix, cortex-m7 or cortex-m4f (default: posix).
        rows: largest number of active constraints; memory grows with its square (default: 2.56 per step, at least 64).
        fly: then fly the scenario with the exported controller on the emulated target, into runs/SCENARIO-TARGET.
        changes: replace a field of the scenario, e.g. --set controller.horizon=30; may be repeated.
        seed: replace the seed of everything random in the scenario.
        progress: as in `fly`.
    """
    import json
    import shlex

    from quadsim.console import results
    from quadsim.console.progress import reporting
    from quadsim.features.export import exporter, in_the_loop
    from quadsim.outputs import run_directory
    from quadsim.scenarios import loading

    flown = loading.load_scenario(scenario, changes, seed)
    options = {"precision": precision, "target": target}
    with reporting(progress, "the export") as report:
        report("export", 0, 1)
        directory = exporter.export(flown, out, overwrite=overwrite, rows=rows, **options)  # type: ignore[arg-type]
    facts = json.loads((directory / exporter.FACTS).read_text())
    memory = exporter.memory_sentence(facts)
    make = f"make -C {shlex.quote(str(directory))} check"
    text = f"{precision}: {memory}\nWrote {directory}: {make} compiles it and checks its recorded periods"
    if not fly:
        return results.Document(f"{text}\n", {"directory": str(directory)})
    _log.info(text.replace("\n", "; "))
    with run_directory(f"{flown.name}-{target}", None, overwrite=False) as place:
        return in_the_loop.fly_exported(flown, place, progress=progress, **options)  # type: ignore[arg-type]
