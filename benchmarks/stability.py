"""The margins of every law of the library on three vehicles: how fast a loop settles, and what makes it unstable.

The laws with weights have those of the vehicle's scenario, the others their defaults, at its control period; `robust`
turns its model by the heading.  Rotors are ideal but for the lag that is varied.
"""

from __future__ import annotations

import time as clock
from collections.abc import Mapping
from contextlib import closing
from dataclasses import fields, is_dataclass
from functools import partial
from typing import Any, Final

from timing import Record, options, run

import quadsim
from quadsim.console.progress import Progress
from quadsim.errors import QuadsimError
from quadsim.features.stability.margins import LoopMargins, MeasuredLoop, loop_margins
from quadsim.features.stability.quantities import VARIED
from quadsim.rollout.growth import SIZE
from quadsim.rollout.many import fly_many
from quadsim.scenarios.schema.controllers import LAWS, TABLES
from quadsim.scenarios.schema.scenario import Scenario

SCENARIOS: Final = {
    "paper's": "paper-constrained",
    "Hummingbird": "hummingbird-figure-eight",
    "Crazyflie": "crazyflie-steps",
}
"""By vehicle, the scenario whose weights the laws have."""
OVER: Final = ("heading", "delay", "lag", "thrust")


def with_law(scenario: Scenario, law: str) -> Scenario:
    """Return a scenario with another law, and the numbers of its controller that this law has, too."""
    own: Mapping[str, Any] = scenario.tables["controller"]
    if law == scenario.controller.type:
        return scenario
    table = TABLES[law]
    assert is_dataclass(table)
    names = {field.name for field in fields(table)}
    kept: dict[str, Any] = {}
    if "output_weights" in names:
        kept = {name: value for name, value in own.items() if name in names}
    turning = {"heading": True} if law == "robust" else {}  # the switch by which it differs here from constrained
    return scenario.replace({"controller": kept | turning | {"type": law}})


def margins_of(case: tuple[str, str]) -> Record:
    """Return the margins of a law on a vehicle, and the time that they took one core."""
    vehicle, law = case
    scenario = with_law(quadsim.load(SCENARIOS[vehicle]), law)
    started = clock.process_time()
    loop = MeasuredLoop(name=law, scenario=scenario, size=SIZE)
    try:
        measured = loop_margins(loop, [VARIED[name] for name in OVER])
    except QuadsimError as error:
        return {"law": law, "vehicle": vehicle, "growth [1/s]": str(error)}
    record: Record = {"law": law, "vehicle": vehicle, "growth [1/s]": f"{measured.growth.rate:.2f}"}
    for name in OVER:
        record[VARIED[name].label] = _text(measured, name)
    return record | {"core [s]": round(clock.process_time() - started)}


def _text(measured: LoopMargins, name: str) -> str:
    """Return both sides of a margin as text."""
    margin = measured.margins.get(name)
    if margin is None:
        return "-"
    texts = []
    for side, sign in ((margin.lower, "<"), (margin.upper, ">")):
        if side is None:
            continue
        ending = " *" if side.state == "no flight" else ""
        beyond = f"{sign} " if side.unstable is None else ""
        texts.append(f"{beyond}{side.stable:.3g}{ending}")
    return " .. ".join(texts)


def measure(quick: bool, progress: Progress) -> list[Record]:
    """Measure every law on every vehicle."""
    cases = [(vehicle, law) for vehicle in SCENARIOS for law in LAWS]
    if quick:
        cases = [("paper's", "lqr")]
    records: list[Record] = [{} for _ in cases]
    progress("loops", 0, len(cases))
    with closing(fly_many(cases, margins_of, timeout=3600.0)) as rows:
        for done, (place, row) in enumerate(rows, start=1):
            progress("loops", done, len(cases))
            if "verdict" in row:
                raise QuadsimError(f"{', '.join(cases[place])}: {row['verdict']} ({row['reason']})")
            records[place] = row
    return records


def main() -> None:
    """Measure, print and write."""
    chosen = options(__doc__)
    run(
        partial(measure, chosen.quick),
        "Stable from .. to (<, >: the end of the range; *: no flight beyond)",
        chosen.json,
    )


if __name__ == "__main__":
    from stability import main as start  # worker processes import `margins_of` by its module's name

    start()
