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
    kept = {name: table[name] for name in ("horizon", "output_weights", "input_weights")}
    return CONSTRAINED.replace({"controller": {"type": "unconstrained", **kept}})


def main(picture: str = "constraint_cost.png", duration: float = 60.0) -> None:
    """Fly, print the tables, draw the figure."""
    bounded, free = (each.replace({"duration": duration}) for each in (CONSTRAINED, without_constraints()))
    figure, (left, right) = plt.subplots(1, 2, figsize=(10.0, 3.8), layout="constrained")

    print("bound [deg]   RMS x, y, z [m]     peak tilt [deg]   largest step [rad/s]   step p50, p99 [ms]")
    errors = []
    for bound in (*BOUNDS, math.inf):
        pair = {name: [-bound, bound] for name in ("roll", "pitch")}
        flight = quadsim.fly(
            free if math.isinf(bound) else bounded.replace({"controller.output_bounds": pair}), progress=False
        )
        rmse = [flight.metrics[f"rmse.{axis}"] for axis in "xyz"]
        tilt = max(abs(flight.plant[name]).max() for name in ("roll", "pitch")) * 180.0 / math.pi
        step = max(abs(flight.summary["control"][name]) for name in ("slew_min", "slew_max"))
        times = flight.summary["controller"]["step_ms"]
        numbers = (*rmse, tilt, step, times["p50"], times["p99"])
        print("{:>8}   {:7.3f} {:6.3f} {:6.3f} {:13.2f} {:20.1f} {:16.2f} {:6.2f}".format(bound, *numbers))
        errors.append(rmse[0])
    left.plot(BOUNDS, errors[:-1], "o-", label="constrained")
    left.axhline(errors[-1], color="C3", linestyle="--", label="without constraints")
    left.set(xlabel="bound on roll and pitch [deg]", ylabel="RMS error of x [m]", yscale="log")

    print("\nhorizon   RMS x [m]: constrained, without constraints")
    fields = {"controller.horizon": HORIZONS}
    sweeps = [quadsim.sweep(each, fields, progress=False) for each in (bounded, free)]
    columns = [[math.nan if v == "lost" else x for v, x in zip(s["verdict"], s["rmse.x"], strict=True)] for s in sweeps]
    for horizon, *pair in zip(HORIZONS, *columns, strict=True):
        print(f"{horizon:>7}   " + ", ".join("lost" if math.isnan(error) else f"{error:.3f}" for error in pair))
    for column, look in zip(columns, ("C0o-", "C3o--"), strict=True):
        right.plot(HORIZONS, column, look)
    right.set(xlabel="horizon N (none: lost)", ylabel="RMS error of x [m]", yscale="log")
    left.legend()
    figure.savefig(picture, dpi=120)


if __name__ == "__main__":
    given = sys.argv[1:]
    main(given[0] if given else "constraint_cost.png", float(given[1]) if len(given) > 1 else 60.0)
