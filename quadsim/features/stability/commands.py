"""The command `quadsim stability`.

It measures how fast a small push in hover grows or decays, and up to which heading, delay, lag, mass, thrust, ... the
closed loop stays stable.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

from cyclopts import Parameter

from quadsim.errors import ParameterError
from quadsim.features.arguments import Changes, File, Flag, Labels, ScenarioName, Watched, Whole

if TYPE_CHECKING:
    from quadsim.features.stability.margins import MeasuredLoop
    from quadsim.features.stability.report import Stability
    from quadsim.scenarios.schema.scenario import Scenario

    Controllers: TypeAlias = object
else:
    Stability = Any
    Controllers = Annotated[Sequence[str], Parameter(consume_multiple=True)]


def stability(
    scenario: ScenarioName,
    /,
    *,
    over: Labels = (),
    controller: Controllers = (),
    map: Labels = (),
    heading: float | None = None,
    size: float | None = None,
    out: File | None = None,
    overwrite: Flag = False,
    workers: Whole | None = None,
    changes: Changes = (),
    seed: Whole | None = None,
    progress: Watched = True,
) -> Stability:
    """Measure the margins of a closed loop: how fast it settles, and what makes it unstable.

    Two flights of one seed hold a hover, one of them pushed a little; the growth of their difference shows whether the
    loop is stable, whatever its controller.  Each quantity is then changed in both directions, by bisection to 2 %.

    Args:
        scenario: library name, or path to a TOML file; its vehicle, controller, effects and sensors are used.
        over: quantities: heading, delay, lag, mass, thrust, inertia, period, drag, tilt (default: all).
        controller: controllers side by side, in place of the scenario's: their names, module:Class, or scenarios
            whose controller is meant; in Python also classes.
        map: two quantities; the loop is also measured over both together.
        heading: of the nominal hover [deg] (default: the one that the course has most).
        size: velocity [m/s] of a second, larger push, for which everything is measured too, as a test of the region of
            attraction.
        out: directory for the table, the figures and summary.json.
        overwrite: replace an earlier output, if its summary.json lists every file in the directory.
        workers: processes (default: one per core).
        changes: replace a field of the scenario, e.g. --set controller.horizon=30; may be repeated.
        seed: replace the seed of everything random in the scenario.
        progress: whether to show a bar on a terminal, and elsewhere a line every ten seconds.

    Returns:
        The `loops`, one for each controller and size, with `growth`, `margins` by quantity, and the `closest` of them;
        and the `maps`.

    Raises:
        InputError: a quantity or a controller does not exist, or a loop cannot be built.
        OutputError: the directory exists, or cannot be written.

    Examples:
        >>> import quadsim
        >>> report = quadsim.stability("hover", over=["delay"], workers=1, progress=False)
        >>> loop = report.loops[0]
        >>> loop.growth.verdict, loop.growth.rate < -1.5  # [1/s]
        ('stable', True)
        >>> delay = loop.margins["delay"].upper
        >>> delay.stable, delay.unstable  # [ms]
        (75.0, 76.0)
    """
    from contextlib import nullcontext

    from quadsim.console.progress import reporting
    from quadsim.console.results import after
    from quadsim.features.stability.margins import LoopMeasurement
    from quadsim.features.stability.quantities import quantities_named
    from quadsim.features.stability.report import Stability as Report
    from quadsim.outputs import reserving
    from quadsim.rollout.growth import SIZE, hovering
    from quadsim.scenarios.loading import load_scenario

    quantities = quantities_named(over)
    pair = _pair(map)
    if pair is not None:
        missing = [quantity for quantity in quantities_named(pair) if quantity not in quantities]
        quantities = (*quantities, *missing)
    if size is not None and not SIZE < size <= 5.0:
        raise ParameterError("", "--size", size, f"above {SIZE:g} and at most 5 m/s")
    stated = load_scenario(scenario, changes, seed)
    if heading is not None:
        if not abs(heading) <= 180.0:
            raise ParameterError("", "--heading", heading, "within +-180 deg")
        stated = hovering(stated, heading=heading)
    loops = _loops(stated, controller, size)
    with (
        nullcontext() if out is None else reserving(out, overwrite=overwrite),
        reporting(progress, "the stability check") as report,
    ):
        measurement = LoopMeasurement(loops, workers=workers, progress=report)
        measured = measurement.margins(quantities)
        maps = []
        if pair is not None:
            for loop, margins in zip(loops, measured, strict=True):
                if {*pair} <= {*margins.margins}:  # both quantities have a margin
                    maps.append(measurement.map(loop, margins, pair))
    result = Report(scenario=stated.name, loops=tuple(measured), quantities=quantities, maps=tuple(maps))
    if out is None:
        return result
    with after(result, Path(out)):
        return result.write(Path(out), overwrite=overwrite)


def _pair(names: Sequence[str]) -> tuple[str, str] | None:
    """Return the two quantities of a map; None without one."""
    if not names:
        return None
    if len(names) != 2 or names[0] == names[1]:
        raise ParameterError("", "--map", list(names), "names of two different quantities")
    return names[0], names[1]


def _loops(scenario: Scenario, controllers: object, size: float | None) -> list[MeasuredLoop]:
    """Return the loop of each controller with the small push, and with one of a `size` [m/s] where it is given."""
    from quadsim.features.stability.margins import MeasuredLoop
    from quadsim.rollout.growth import SIZE

    loops = []
    for name, flown in _flown(scenario, controllers):
        loops.append(MeasuredLoop(name=name, scenario=flown, size=SIZE))
        if size is not None:
            loops.append(MeasuredLoop(name=name, scenario=flown, size=size))
    return loops


def _flown(scenario: Scenario, controllers: object) -> list[tuple[str, Scenario]]:
    """Return each controller's name with the scenario that has it, with the numbers of its vehicle's file."""
    from quadsim.scenarios.assembly import Assembly

    if not isinstance(controllers, list | tuple):
        controllers = [controllers]
    flown = [_with_controller(scenario, controller) for controller in controllers]
    if not flown:
        flown = [(str(scenario.controller.type), scenario)]
    return [(name, Assembly(named).recorded.scenario) for name, named in _distinct(flown)]


def _with_controller(scenario: Scenario, controller: object) -> tuple[str, Scenario]:
    """Return a controller's name, and the scenario with it.

    A controller of the scenario's own type keeps the scenario's settings.
    """
    from quadsim.scenarios.loading import load_scenario
    from quadsim.scenarios.plugin import is_plugin
    from quadsim.scenarios.schema.controllers import LAWS
    from quadsim.scenarios.schema.writing import plain
    from quadsim.scenarios.user_code import importable

    if not isinstance(controller, str | Path):
        named = importable(scenario, controller)
        return named.controller.type.rpartition(":")[2], named
    text = str(controller)
    if text == scenario.controller.type:
        return text, scenario
    if text in LAWS:
        return text, scenario.replace({"controller": {"type": text}})
    if is_plugin(text):
        return text.rpartition(":")[2], importable(scenario, text)
    other = load_scenario(text)
    return other.name, scenario.replace({"controller": plain(other.controller)})


def _distinct(flown: list[tuple[str, Scenario]]) -> list[tuple[str, Scenario]]:
    """Return the same with distinct names: `lqr`, `lqr (2)`, ..."""
    names = [name for name, _ in flown]
    numbered = []
    for i, (name, scenario) in enumerate(flown):
        count = names[: i + 1].count(name)
        if count > 1:
            name = f"{name} ({count})"
        numbered.append((name, scenario))
    return numbered
