"""Remake docs/speed.md and its figure, `quadsim bench speed` with words: `make speed`, some two minutes.

No clock decides any of it; tests/scenarios/bench/test_speed.py flies the short ones.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from make_numbers import Table, copy_figure, markdown, write_page

from quadsim.report.figures.canvas import write_drawings
from quadsim.report.table import section
from scenarios.bench.speed import LAWS, NEAR, ROOM, STEEPEST, SpeedBench, SpeedFlight, speed_legend, speed_tables
from scenarios.bench.speed_figure import draw_speeds
from scenarios.benchmarks import bench_speed

LINEAR = [law for law in LAWS if LAWS[law].linear]
OTHERS = [law for law in LAWS if law not in LINEAR]
STEEP = 60.0 + ROOM  # [deg]
READING = """\
- What ends linear control here is tilt. On the loop as modelled, where the linearisation alone is wrong, linear MPC is
  off by centimetres at 4 m/s and by a metre or more at 12, nonlinear MPC by millimetres.
- Up to some 50 deg, where the plant is not as modelled, nonlinear MPC by itself pays little. Under drag a PID, which
  integrates, is nearer up to 8 m/s; with real rotors linear MPC is off by at most twice as much. To observe the force
  pays more there: `nonlinear +` under drag and with real rotors, `geometric +` under drag and on the Hummingbird.
- Nonlinear need not be MPC: `geometric +` has the smallest error on the loop as modelled. It bounds only what it
  commands, and is beyond its bound at the highest speeds, where its rotors saturate; `nonlinear` never is.
- By sensors to observe forces does not pay: the estimate's noise passes up to the observers' bandwidths, `nonlinear +`
  is farther off than `nonlinear`, and a seed of `geometric +` is lost at 6 m/s.
- Within a wide bound linear MPC plans what its model does not describe. `constrained`, with hard bounds and without
  estimated disturbances, is lost where `robust` survives far off the course; on the Crazyflie at 5 m/s both are lost.
- The LQR is a metre off at 4 m/s already: it follows the reference's velocity, not its acceleration.
- The heading is held, which in steep turns takes torque about body z, where the vehicle of the loop is weak: PID and
  geometric control saturate on the loop from 8 m/s on.
"""


def best(measured: SpeedBench, world: str, speed: float, laws: list[str]) -> tuple[float, str]:
    """The smallest mean error among some laws [m], and whose it is."""
    errors = {law: measured.flights[world, speed, law].error for law in laws}
    return min((error, law) for law, error in errors.items() if error is not None)


def gains(measured: SpeedBench) -> Table:
    """The best linear controller against the nonlinear MPC, and against the best of all that are not linear."""
    rows: Table = [("course", "m/s", "best linear", "its error [m]", "nonlinear / it", "best other", "best other / it")]
    for world, speeds in measured.worlds.items():
        for speed in speeds:
            error, law = best(measured, world, speed, LINEAR)
            plain, _ = best(measured, world, speed, ["nonlinear"])
            other, winner = best(measured, world, speed, OTHERS)
            rows.append(
                (world, f"{speed:g}", law, f"{error:.3f}", f"{plain / error:.3f}", winner, f"{other / error:.3f}")
            )
    return rows


def counts(measured: SpeedBench) -> Table:
    """How many flights of each law went how, all and those on courses that take a steep tilt."""
    rows: Table = [
        ("controller", "lost", "beyond the bound, not lost", "followed within it", "of", "steep: followed", "of")
    ]
    for law in measured.laws:
        flights = [flight for (_, _, name), flight in measured.flights.items() if name == law]
        steep = [flight for flight in flights if flight.bound >= STEEP]
        lost = sum(flight.error is None for flight in flights)
        beyond = sum(flight.error is not None and flight.violated > 0.0 for flight in flights)
        good, good_steep = (sum(map(followed, some)) for some in (flights, steep))
        rows.append((law, *map(str, (lost, beyond, good, len(flights), good_steep, len(steep)))))
    return rows


def followed(flight: SpeedFlight) -> bool:
    """Near the course, and within the bound."""
    return flight.error is not None and flight.error <= NEAR and not flight.violated


def page(measured: SpeedBench) -> str:
    """The whole page."""
    reach, *tables = speed_tables(measured)
    return "\n".join(
        [
            "# Where linear control ends\n\nMade by `make speed`, its numbers by flights; `quadsim bench speed` prints "
            f"the tables.\n\nEvery controller flies a course ever faster:\n\n{speed_legend(measured)}\n"
            f"Roll and pitch are bounded by what the course takes without drag and {ROOM:g} deg more, at most "
            f"{STEEPEST:g} deg; the controllers\nwithout bounds limit the tilt that they command to it. Where "
            "sensors measure, numbers are means over seeds, with the 95 % interval of the mean error; elsewhere\n"
            "nothing is random. What noise adds to the loop is in [papers.md](papers.md#noise-over-seeds). A vehicle "
            "farther off than the course's size,\nor tilted by more than 120 deg, is lost.\n",
            "[![Mean position error and share of the time beyond the tilt bound over speed](speed.png)](speed.png)\n",
            section(reach),
            f"## What is seen\n\n{markdown(counts(measured))}\nFollowed: a mean error of at most {NEAR:g} m, and "
            f"within the bound all the time. Steep: the course takes some {STEEP - ROOM:g} deg or more.\n\n{READING}\n"
            f"Ratios of mean errors; *best other* is of {', '.join(OTHERS)}:\n\n" + markdown(gains(measured)),
            *(section(grid) for grid in tables),
        ]
    )


def main() -> None:
    """Fly everything and write the page."""
    measured = bench_speed()
    with tempfile.TemporaryDirectory() as scratch:
        write_drawings({"speed": lambda: draw_speeds(measured)}, Path(scratch))
        copy_figure(Path(scratch) / "speed.png", "speed.png", 64)
    write_page("speed.md", page(measured))


if __name__ == "__main__":
    main()
