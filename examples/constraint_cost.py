"""What do constraints cost?  The paper's flight with its constraints and without: `python examples/constraint_cost.py`.

Weights and course stay the same.  The bound on roll and pitch moves first, then the horizon.  It prints two tables and
draws constraint_cost.png, or the file that is named.
"""

import math
import sys
import tomllib

import matplotlib.pyplot as plt

import quadsim

BOUNDS = (2.0, 3.0, 5.0, 7.0, 10.0, 20.0)  # deg, on roll and pitch
HORIZONS = [10, 20, 30, 50, 100]
CONSTRAINED = quadsim.load("paper-constrained").replace({"constraints": []})


def without_constraints() -> quadsim.Scenario:
    """The same weights and horizon, a constant gain."""
    table = tomllib.loads(CONSTRAINED.to_toml())["controller"]
    controller = {"type": "unconstrained"}
    for name in ("horizon", "output_weights", "input_weights"):
        controller[name] = table[name]
    return CONSTRAINED.replace({"controller": controller})


def print_flight(bound: float, flight: quadsim.Flight) -> None:
    """Print a line: errors, peak tilt, largest step of a rotor speed, and times of the controller."""
    errors = [flight.metrics[f"rmse.{axis}"] for axis in "xyz"]
    roll = abs(flight.plant["roll"]).max()
    pitch = abs(flight.plant["pitch"]).max()
    tilt = max(roll, pitch) * 180.0 / math.pi
    control = flight.summary["control"]
    step = max(abs(control["slew_min"]), abs(control["slew_max"]))
    times = flight.summary["controller"]["step_ms"]
    numbers = (*errors, tilt, step, times["p50"], times["p99"])
    print("{:>8}   {:7.3f} {:6.3f} {:6.3f} {:13.2f} {:20.1f} {:16.2f} {:6.2f}".format(bound, *numbers))


def errors_by_horizon(scenario: quadsim.Scenario) -> list[float]:
    """RMS error of x [m] at each horizon; NaN where the flight is lost."""
    table = quadsim.sweep(scenario, {"controller.horizon": HORIZONS}, progress=False)
    errors = []
    for verdict, error in zip(table["verdict"], table["rmse.x"], strict=True):
        if verdict == "lost":
            errors.append(math.nan)
        else:
            errors.append(error)
    return errors


def shown(error: float) -> str:
    """An error [m] as text."""
    if math.isnan(error):
        return "lost"
    return f"{error:.3f}"


def main(picture: str = "constraint_cost.png", duration: float = 60.0) -> None:
    """Fly, print the tables, draw the figure."""
    bounded = CONSTRAINED.replace({"duration": duration})
    free = without_constraints().replace({"duration": duration})
    figure, (left, right) = plt.subplots(1, 2, figsize=(10.0, 3.8), layout="constrained")

    print("bound [deg]   RMS x, y, z [m]     peak tilt [deg]   largest step [rad/s]   step p50, p99 [ms]")
    errors = []
    for bound in BOUNDS:
        bounds = {"roll": [-bound, bound], "pitch": [-bound, bound]}
        flight = quadsim.fly(bounded.replace({"controller.output_bounds": bounds}), progress=False)
        print_flight(bound, flight)
        errors.append(flight.metrics["rmse.x"])
    flight = quadsim.fly(free, progress=False)
    print_flight(math.inf, flight)
    left.plot(BOUNDS, errors, "o-", label="constrained")
    left.axhline(flight.metrics["rmse.x"], color="C3", linestyle="--", label="without constraints")
    left.set(xlabel="bound on roll and pitch [deg]", ylabel="RMS error of x [m]", yscale="log")

    print("\nhorizon   RMS x [m]: constrained, without constraints")
    bounded_errors = errors_by_horizon(bounded)
    free_errors = errors_by_horizon(free)
    for horizon, bounded_error, free_error in zip(HORIZONS, bounded_errors, free_errors, strict=True):
        print(f"{horizon:>7}   {shown(bounded_error)}, {shown(free_error)}")
    right.plot(HORIZONS, bounded_errors, "C0o-")
    right.plot(HORIZONS, free_errors, "C3o--")
    right.set(xlabel="horizon N (none: lost)", ylabel="RMS error of x [m]", yscale="log")
    left.legend()
    figure.savefig(picture, dpi=120)


if __name__ == "__main__":
    picture = "constraint_cost.png"
    duration = 60.0
    if len(sys.argv) > 1:
        picture = sys.argv[1]
    if len(sys.argv) > 2:
        duration = float(sys.argv[2])
    main(picture, duration)
