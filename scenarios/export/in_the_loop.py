"""Processor in the loop: a flight whose controller is an exported one, on its target or in the target's emulator."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from mpc.answer import ActuatorBounds
from mpc.core.law import ANSWERERS, LEVELS, STATUSES
from mpc.export.ctext import Precision
from mpc.export.targets import TARGETS, Target
from mpc.ocp import Problem
from quadsim.controller import GAIN, GROUNDED, UNCONSTRAINED, Command, Moment, stopped
from quadsim.outputs import reserving
from quadsim.state import Array
from quadsim.vehicle import N_ROTORS
from scenarios.assembly import Assembly
from scenarios.export.emulation import Program, build, require_programs
from scenarios.export.exporter import c_controller, exported_law, programs
from scenarios.export.serial_line import SerialMPC
from scenarios.flight import Flight
from scenarios.limits import with_bounds_stated
from scenarios.loading import load_scenario
from scenarios.progress import Progress, reporting
from scenarios.rollout import Rollout
from scenarios.schema.scenario import Scenario


class MPCInTheLoop:
    """An exported controller at the other end of a serial line, as a controller that flies.

    While landed the rotors are taken to their lowest speed as fast as their bounds allow, here and not there.

    Attributes:
        ways: how many periods had which status of `quadsim_mpc.h`.
    """

    predict: Callable[[Array, Array], Array]  # there is none: plans stay where they are made

    def __init__(self, serial: SerialMPC, problem: Problem, name: str, target: Target) -> None:
        self.name, self.solver, self.horizon = name, f"C99 on {target.title}", problem.horizon
        self.ways = [0] * len(STATUSES)
        self._serial, self._before = serial, problem.model.u_bar[:N_ROTORS]
        self._bounds = ActuatorBounds.of_problem(problem) if problem.every_constraint else None

    def reset(self, speeds: Array) -> None:
        """See `quadsim.controller.Controller.reset`."""
        self._before, self.ways = np.array(speeds, float), [0] * len(STATUSES)
        self._serial.reset(speeds)

    def step(self, now: Moment, state: Array, reference: Array) -> Command:
        """See `quadsim.controller.Controller.step`.

        Raises:
            FlightError: no answer came over the line.
        """
        acting = self._before if now.acting is None else now.acting
        if now.phase in GROUNDED:
            self._before = np.zeros(N_ROTORS) if self._bounds is None else self._bounds.reach(acting)[0]
            self._serial.reset(self._before)
            return stopped(self._before.copy(), self.horizon, now.phase)
        reply = self._serial.step(now.time, state, reference, acting)
        self._before = reply.command
        self.ways[reply.status] += 1
        return Command(
            speeds=reply.command.copy(),
            plan=np.tile(reply.command, (self.horizon, 1)),
            status=UNCONSTRAINED if self._bounds is None else STATUSES[reply.status],
            answered_by=GAIN if self._bounds is None else ANSWERERS[reply.status],
            fallback=LEVELS[reply.status],
        )


def fly_exported(
    scenario: Scenario | str | Path,
    out: str | Path | None = None,
    *,
    precision: Precision = "double",
    target: str = "cortex-m7",
    progress: Progress | bool = True,
) -> Flight:
    """Fly a scenario with its controller exported, compiled and run by its target: processor in the loop.

    The controller's program is `serial.c` of the export, at the other end of a serial line: a Cortex-M's UART in QEMU,
    for `posix` a pipe.  Its queries and answers are bytes; the flight is audited as any other, but that a float
    may pass a bound on speeds and their steps by the spacing of floats there.

    Args:
        scenario: it, or its name or file.
        out: the run directory, without a film; nothing is written where absent.
        precision: of the controller's numbers, `double` or `float`.
        target: `cortex-m7`, `cortex-m4f` or `posix`.
        progress: see `quadsim.fly`.

    Raises:
        ExportError: this controller cannot be exported; the message gives the reason.
        MissingProgramError: a compiler or an emulator is not installed.

    Examples:
        >>> import quadsim
        >>> flight = quadsim.fly_exported("hover", target="cortex-m4f", precision="float")  # doctest: +SKIP
    """
    scenario = load_scenario(scenario)
    machine = TARGETS[target]
    files = c_controller(scenario, precision).files | programs(machine, precision)
    require_programs(machine, "to fly an exported controller")
    problem = exported_law(scenario).problem
    if precision == "float" and problem.every_constraint:
        scenario = _allowing(scenario, float(np.spacing(np.float32(ActuatorBounds.of_problem(problem).u_max.max()))))
    with tempfile.TemporaryDirectory(prefix="quadsim-") as scratch, reporting(progress) as report:
        directory = Path(scratch)
        for name, text in files.items():
            (directory / name).write_text(text, encoding="utf-8")
        image = build(directory, "serial.elf", "CPPFLAGS=-DWATCHDOG_MS=0")  # the emulated clock is not the flight's
        with Program(machine, image) as line:
            serial = SerialMPC(line, precision, problem.horizon)
            law = MPCInTheLoop(serial, problem, scenario.controller.type, machine)
            if out is None:
                return Rollout(scenario, law).fly(report)
            with reserving(out) as place:
                flight = Rollout(scenario, law).fly(report)
                flight.save(place, video=False, progress=report)
                return replace(flight, directory=place)


def _allowing(scenario: Scenario, spacing: float) -> Scenario:
    """The scenario with tolerances of at least `spacing` [rad/s] on speeds and their steps."""
    limits = [
        replace(
            limit,
            tolerance=max(spacing, limit.tolerance),
            tolerance_sampled=max(spacing, limit.tolerance_sampled),
        )
        if limit.signal in ("speed", "slew")
        else limit
        for limit in with_bounds_stated(Assembly(scenario)).constraints
    ]
    return scenario.model_copy(update={"constraints": limits})
