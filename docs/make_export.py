"""Remake docs/export.md: `make export-numbers`, some ten minutes.

Instructions, sizes and errors are decided by no clock; the times of this machine are the best of `REPEATS` passes.
With names of peers, `python docs/make_export.py tinympc`, their rows are printed and nothing else is done.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from export_peers import TOOLS, Measured, answered, run_peer, size
from export_tinympc import ITERATIONS, TOLERANCE, own_optima
from make_numbers import Table, markdown, write_page

from mpc.export.source import Precision
from mpc.export.targets import TARGETS
from mpc.ocp import Problem
from quadsim.controller import ACCEPTED
from quadsim.state import Array
from scenarios.bench.campaigns import bench_campaign
from scenarios.build import build_problem
from scenarios.export.emulation import build
from scenarios.export.exporter import export
from scenarios.export.in_the_loop import fly_exported
from scenarios.export.record import Recording, record
from scenarios.loading import load_scenario
from scenarios.machine import machine
from scenarios.parts.vehicle import build_vehicle

REPEATS: Final = 3
PAPER: Final = "paper-constrained"
OTHERS: Final = (
    "paper-unconstrained",
    "crazyflie-steps",
    "hummingbird-figure-eight",
    "polytopes",
    "robust",
    "robust-lag50",
)
OURS, PEERS = "quadsim", ("daqp", "osqp", "tinympc")
PRECISIONS: Final[tuple[Precision, ...]] = ("double", "float")
OPTIMA: Final = 3
"""Statuses below are optima."""
TEXT: Final = """\
# A controller for a flight computer

Made by `make export-numbers`; the tests of `make firmware` hold its bounds.

`quadsim export` writes the controller of a scenario as self-contained C99: no allocation, no recursion, no global
state, of the C library `memcpy` and `memset`. From scenario to target in four commands:

```sh
quadsim run paper-constrained --no-video                  # accept the flight: every constraint audited
quadsim export paper-constrained --out c --target cortex-m7 --fly   # and fly it again, by the emulated processor
make -C c check                                           # its recorded periods, each against the exact optimum
make -C c serial.elf                                      # the controller behind the board's serial line
```

The first two need no compiler but for `--fly`; the others `gcc-arm-none-eabi`, and QEMU to run what they made. For this
computer: `--target posix`. In half the memory: `--precision float`. `c/README.md` describes the files;
`c/quadsim_mpc.h` is the interface, with the order of states, units and frames. A directory in which `make` has built
is exported to again after `make clean`.

## What it takes

The controller of {scenario}, N = {horizon}, {periods} recorded periods of its flight, of which {ways}. Flash is code
and constants of the controller alone, RAM its struct, which the caller owns, frame the largest of a
function on the stack, all of which takes less than 4000 B in the tests. **Instructions
of a step, in millions, are counted by an emulator: they are not cycles.** It has no caches, no wait states of flash, no
pipeline; a processor takes more than one cycle for some, and flash is slow where it is not cached. No hardware was at
hand.

{sizes}
The first step begins on the ground without an active set, and takes by far the most: solve once before take-off. Error
is the largest distance of any command from the exact optimum.

Others of the library, in double on the Cortex-M7:

{others}
On this computer ({processor}), in double, each period the best of {repeats} passes: {host}.

{aims}
## In campaigns

With `controller.compiled` the same code flies in place of Python's steps (`quadsim bench campaign --set
controller.compiled=true`). Flights of 60 s per core-hour, by one worker:

{campaigns}
## Peers on the same problem

The same recorded periods on the emulated Cortex-M7. DAQP and OSQP are given the condensed QP ({inputs} inputs, {rows}
rows), TinyMPC a state with the last speeds in it, so that all bounds are boxes; what it takes to find their vectors
from state and reference is theirs neither in flash nor in instructions. DAQP begins from its last active set, in the
least-distance form around the optimum without constraints; OSQP's generated code from its last point, with the step
size that it chose itself and tolerances of 1e-4; TinyMPC's from its last point, with its default tolerances of
{tolerance:g} and {iterations} iterations at most, and the step size and units that took the fewest.

{peers}
- DAQP is as exact. It takes more memory, as its matrices are dense, and more instructions: they have no structure, and
  its active set is not shifted from period to period.
- OSQP's answer is not the optimum, but within its tolerances; its matrices are in RAM.
- TinyMPC solves another problem: its last state has the weight of its own Riccati equation, in which its step size
  is a weight too. That problem's optimum, found by another solver, is up to {gap} rad/s from ours, {usual_gap} in the
  median period. To it, TinyMPC's answers are within {converged} rad/s where they converged, {unconverged} where not.
  Its code, C++ with Eigen, allocates: {heap} kB of its RAM are heap.

## In the loop

`--fly` compiles `serial.c` for the target and flies the scenario with the emulated processor for a controller: a frame
with the state, the next row of the reference and the command in force goes to its UART each period, a command comes
back. The flight is audited as any other.

{loop}
A float may pass a bound on speeds and their steps by the spacing of floats there: the audit allows that.

## On your flight computer

- Call `quadsim_mpc_step` once a period, and give it the command that is in force: `acting`. It always gives a command
  that is finite and within the bounds on speeds; its status states whether it is an optimum, and if not what remained:
  the axes' optimum clipped, the last plan shifted, the command before. Whether to fly on with these is yours to decide.
- `serial.c` is a start: one struct with a CRC-32 each way. What is corrupt, cut or old is dropped, what comes twice is
  solved once. Without a fresh state for 100 ms the last command is sent again with the status `QUADSIM_BEFORE`, until
  one comes. `target.h` is what it needs of a machine; `posix.c` and `startup.c` are two answers. On a pseudo-terminal:
  `python examples/flight_computer.py`.
- Compile with `-ffp-contract=off`, as the Makefile does, and every target gives the bits that were tested.
  `-ffast-math` is refused: it takes away the check that numbers are finite.
- `startup.c` polls the UART, which does for the emulated board: where a step takes longer than the line fills the
  UART's buffer, read by an interrupt. A Cortex-M4F computes doubles in software: export `--precision float` for it.

## What is proven, and what is not

- Cortex-M7, Cortex-M4F and aarch64, emulated, and this computer by gcc and clang give the same bits in all {periods}
  periods, in both precisions.
- gcc with all warnings and `-fanalyzer`, clang, cppcheck and clang-tidy find nothing; recursion, allocation, doubles in
  float code and numbers too small for a float are found when they are planted. All stack frames are static.
- Steps from arbitrary bytes under the address and undefined-behaviour sanitizers lead to no fault and no hang, and to
  commands within their bounds: ten thousand of each controller in each run of the tests, a million in double and float
  together by `FUZZ_RUNS=130000 make firmware OPTIONS="-k 'arbitrary and short' --dist load"`, half an hour.
- In float `polytopes` alone, of all that the tests export, is farther than 0.02 rad/s from the exact optimum in one
  period: 0.05 rad/s, and its `make check` says so.
- Not proven: an optimum wherever there is one. There is room for {room} active rows (`QUADSIM_ROOM`) and for {changes}
  changes of them in a step (`QUADSIM_CHANGES`). Far from the reference more are active, as 3 m away in x, y and z
  together, and the answer is `QUADSIM_CLIPPED`. Both are macros: `make CPPFLAGS=-DQUADSIM_ROOM=256` takes
  more RAM, with the square of the room.
- Not proven: time. The numbers above are those of flights, and harder states take more. Nor has any of it flown: not on
  hardware, and not under its faults.
"""


def ours(scenario: str, precision: Precision, target: str, scratch: Path) -> Measured:
    """An export's answers to its recorded periods."""
    directory = export(scenario, scratch / f"{scenario}-{precision}-{target}", precision=precision, target=target)
    machine, image = TARGETS[target], build(directory, "vectors.elf")
    tool = TOOLS[bool(machine.board)]
    flash, _ = size(tool, [directory / "quadsim_mpc.o"])
    _, memory = size(tool, [directory / "main.o"])
    command = [*machine.emulation, "-serial", "none", "-kernel", image] if machine.board else [image]
    done = subprocess.run(command, capture_output=True, text=True)
    return answered(done.stdout + done.stderr, machine, flash, memory)


def largest_frame(scenario: str, precision: Precision, target: str, scratch: Path) -> int:
    """Bytes, by the compiler's account."""
    report = (scratch / f"{scenario}-{precision}-{target}" / "quadsim_mpc.su").read_text(encoding="utf-8")
    return max(int(line.split("\t")[1]) for line in report.splitlines())


def error(found: Measured, recording: Recording) -> str:
    """The largest distance of commands from the exact optimum, where there is one [rad/s]."""
    optimal = recording.status < OPTIMA
    return f"{np.abs(found.command - recording.command)[optimal].max():.1e}"


def work(found: Measured) -> tuple[str, ...]:
    """Millions of instructions: median, p99, most after the first, and the first."""
    steps = found.ticks / 1e6
    return tuple(f"{value:.2f}" for value in (np.median(steps), np.percentile(steps, 99), steps[1:].max(), steps[0]))


WORK: Final = ("median", "p99", "most, warm", "first step")


def sizes_table(recording: Recording, scratch: Path) -> Table:
    """Size, work and error of the paper's controller on every board."""
    rows: Table = [("target", "precision", "flash [kB]", "RAM [kB]", "frame [B]", *WORK, "error [rad/s]")]
    for target, precision in (("cortex-m7", "double"), ("cortex-m7", "float"), ("cortex-m4f", "float")):
        found = ours(PAPER, precision, target, scratch)
        frame = largest_frame(PAPER, precision, target, scratch)
        kilobytes = (f"{found.flash / 1e3:.0f}", f"{found.memory / 1e3:.0f}", f"{frame}")
        rows.append((TARGETS[target].title, precision, *kilobytes, *work(found), error(found, recording)))
    return rows


def others_table(scratch: Path) -> Table:
    """The same of other scenarios."""
    rows: Table = [("scenario", "flash [kB]", "RAM [kB]", *WORK, "error [rad/s]", "no optimum", "of")]
    for name in OTHERS:
        recording, found = record(load_scenario(name)), ours(name, "double", "cortex-m7", scratch)
        none, count = int((found.status >= OPTIMA).sum()), len(found.status)
        kilobytes = (f"{found.flash / 1e3:.0f}", f"{found.memory / 1e3:.0f}")
        rows.append((name, *kilobytes, *work(found), error(found, recording), f"{none}", f"{count}"))
    return rows


def peers(names: Sequence[str], problem: Problem, recording: Recording, scratch: Path) -> dict[str, Measured]:
    """Others' answers to the paper's recorded periods, each in a directory of its own."""
    found = {}
    for name in names:
        (scratch / name).mkdir()
        found[name] = run_peer(name, scratch / name, problem, recording, TARGETS["cortex-m7"], "double")
    return found


def peers_table(found: dict[str, Measured], recording: Recording) -> Table:
    """Others beside ours."""
    rows: Table = [("", "flash [kB]", "RAM [kB]", *WORK, "error [rad/s]", "unsolved")]
    for name, each in found.items():
        unsolved = (each.status >= OPTIMA if name == OURS else each.status > 0).sum()
        kilobytes = (f"{each.flash / 1e3:.0f}", f"{each.memory / 1e3:.0f}")
        rows.append((name, *kilobytes, *work(each), error(each, recording), f"{unsolved}"))
    return rows


def tinympc_words(found: Measured, problem: Problem, recording: Recording, scratch: Path) -> dict[str, Any]:
    """How far TinyMPC is from its own problem's optimum, and that from ours [rad/s]."""
    optimum, missed = own_optima(problem, recording, scratch / "tinympc"), found.status > 0
    gap, left = (np.abs(optimum - each).max(axis=1) for each in (recording.command, found.command))
    return {
        "tolerance": TOLERANCE,
        "iterations": ITERATIONS,
        "gap": f"{gap.max():.1f}",
        "usual_gap": f"{np.median(gap):.1e}",
        "converged": f"{left[~missed].max():.2f}",
        "unconverged": f"{left[missed].max():.1f}",
        "heap": f"{found.heap / 1e3:.0f}",
    }


def loop_table() -> Table:
    """Flights by emulated processors."""
    rows: Table = [("controller by", "precision", "outcome", "periods with an optimum", "roll at most [deg]")]
    for target, precision in (("cortex-m7", "double"), ("cortex-m4f", "float")):
        flight = fly_exported(PAPER, target=target, precision=precision, progress=False)  # type: ignore[arg-type]
        optimal = sum(status in ACCEPTED for status in flight.log.control.status)
        roll = np.degrees(np.abs(flight.log.control.state[:, 6]).max())
        periods = f"{optimal} of {len(flight.log.control.status)}"
        rows.append((TARGETS[target].title, precision, flight.outcome, periods, f"{roll:.4f}"))
    return rows


def host_times(scratch: Path) -> Array:
    """Microseconds of each period on this computer, the best of the passes."""
    passes = [ours(PAPER, "double", "posix", scratch / str(i)).ticks for i in range(REPEATS)]
    best: Array = np.min(passes, axis=0) / 1e3
    return best


def aims_table(sizes: Table, host: Array) -> Table:
    """What was aimed at, and what was reached."""
    by_name = {row[:2]: [float(cell) for cell in row[2:-1]] for row in sizes[1:]}
    rows: Table = [("", "aim", "measured", "verdict")]
    for precision, flash, memory in (("double", 200, 90), ("float", 105, 46)):
        found = by_name["Cortex-M7", precision]
        checks: list[tuple[str, float, float]] = [
            (f"flash, {precision} [kB]", flash, found[0]),
            (f"RAM, {precision} [kB]", memory, found[1]),
            (f"instructions of a Cortex-M7, {precision}: median [M]", 0.1, found[3]),
            ("the same, p99", 3.0, found[4]),
            ("the same, most after the first", 12.0, found[5]),
        ]
        rows += [verdict(*each) for each in checks]
    times = (float(np.median(host)), float(np.percentile(host, 99)), float(host.max()))
    for name, aim, each in zip(("median", "p99", "most, the first one"), (4.0, 200.0, 1000.0), times, strict=True):
        rows.append(verdict(f"this computer, double, {name} [us]", aim, each))
    return rows


def verdict(name: str, aim: float, found: float) -> tuple[str, ...]:
    """A row of the aims."""
    return name, f"<= {aim:g}", f"{found:.3g}", "met" if found <= aim else "missed"


def campaigns_table() -> Table:
    """Flights per core-hour, by Python's steps and compiled ones."""
    rows: Table = [("controller", "Python", "compiled", "aim")]
    for name, aim in ((PAPER, 7000), ("robust", 3000)):
        found = [
            bench_campaign(
                load_scenario(name, ["duration=60", f"controller.compiled={compiled}"]), rounds=3, flights=20, sizes=()
            ).per_core_hour
            for compiled in ("false", "true")
        ]
        rows.append((name, *(f"{each:.0f}" for each in found), f">= {aim}"))
    return rows


def main() -> None:
    """Measure everything and write the page; with names of peers, print their rows."""
    scenario = load_scenario(PAPER)
    recording = record(scenario)
    problem = build_problem(scenario, build_vehicle(scenario))
    if sys.argv[1:]:
        with tempfile.TemporaryDirectory() as directory:
            found = peers(sys.argv[1:], problem, recording, Path(directory))
            print(markdown(peers_table(found, recording)))
            if "tinympc" in found:
                print(tinympc_words(found["tinympc"], problem, recording, Path(directory)))
        return
    ways = np.bincount(recording.status, minlength=OPTIMA)
    with tempfile.TemporaryDirectory() as directory:
        scratch = Path(directory)
        sizes, host = sizes_table(recording, scratch / "sizes"), host_times(scratch / "host")
        header = (scratch / "sizes" / f"{PAPER}-double-cortex-m7" / "quadsim_mpc.h").read_text(encoding="utf-8")
        ((room, changes),) = re.findall(r"QUADSIM_ROOM (\d+).*?QUADSIM_CHANGES (\d+)", header, re.DOTALL)
        mine = ours(PAPER, "double", "cortex-m7", scratch / "mine")
        others = peers(PEERS, problem, recording, scratch)
        page = TEXT.format(
            **tinympc_words(others["tinympc"], problem, recording, scratch),
            scenario=PAPER,
            horizon=problem.horizon,
            periods=len(recording.status),
            ways=f"{ways[0]} are free optima, {ways[1]} optima by axes and {ways[2]} of the whole problem",
            sizes=markdown(sizes),
            others=markdown(others_table(scratch / "others")),
            processor=machine()["processor"],
            repeats=REPEATS,
            host=f"{np.median(host):.1f} us median, {np.percentile(host, 99):.0f} us p99, {host[1:].max():.0f} us at "
            f"most after the first, which takes {host[0]:.0f} us",
            aims=markdown(aims_table(sizes, host)),
            campaigns=markdown(campaigns_table()),
            inputs=problem.horizon * 4,
            rows=problem.horizon * problem.rows.l1.size,
            peers=markdown(peers_table({OURS: mine, **others}, recording)),
            loop=markdown(loop_table()),
            room=room,
            changes=changes,
        )
    write_page("export.md", page)


if __name__ == "__main__":
    main()
