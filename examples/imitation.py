"""A network imitates the paper's controller, and is audited like it: `python examples/imitation.py`, two minutes.

The teacher flies courses of random steps, the student learns its commands by least squares, then flies itself while the
teacher labels them with its own actions (data aggregation: Ross, Gordon and Bagnell, 2011, "A reduction of imitation
learning and structured prediction to no-regret online learning").  Both then fly courses that neither has seen.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import quadsim
import quadsim.gym
from quadsim.errors import FlightError

Array = NDArray[np.float64]

OBSERVED: dict[str, Any] = {"observation": ("ahead", "state", "command"), "action": "speeds"}
AHEAD = [1, 2, 4, 7, 11, 16, 22, 29, 37, 45, 50]
"""Periods ahead of which the student sees the reference."""
MOVING = [1, 3, 5, 6, 7, 8, 9, 11]
"""States that it sees: velocities, roll, pitch and all rates; where it is, and its yaw, are in what lies ahead."""
TOLERANCE = 0.2  # deg, of roll and pitch
INPUTS = 4 * len(AHEAD) + len(MOVING) + 4


def course(seed: int) -> quadsim.Scenario:
    """Steps of 2 to 5 m along each axis at random times, and a start at a random yaw."""
    rng = np.random.default_rng(seed)
    changes: dict[str, object] = {"initial.euler": [0.0, 0.0, float(rng.uniform(-30.0, 30.0))], "duration": 30.0}
    for axis in "xyz":
        start, size = rng.uniform(0.0, 8.0), rng.uniform(2.0, 5.0) * rng.choice([-1.0, 1.0])
        changes[f"reference.{axis}"] = [{"start": float(start), "stop": float(start + 10.0), "value": float(size)}]
    for axis in ("roll", "pitch"):  # between samples, and beyond the linear model, the teacher is off by some 0.1 deg
        changes |= {f"constraints.{axis}.tolerance": TOLERANCE, f"constraints.{axis}.tolerance_sampled": TOLERANCE}
    every = quadsim.load("paper-constrained").replace(changes)
    return every.model_copy(update={"constraints": [each for each in every.constraints if "arrival" not in each.name]})


def features(state: Array, preview: Array, command: Array, hover: float) -> Array:
    """(56,) what the network is given, of a state (12,), a reference (N, 4) and the command in force (4,)."""
    ahead = preview[[i - 1 for i in AHEAD]] - state[[0, 2, 4, 10]]
    return np.concatenate([ahead.ravel() / 5.0, state[MOVING] * 2.0, (command - hover) / 10.0])


def of_observation(observed: Array, hover: float) -> Array:
    """The same of an observation `ahead`, `state`, `command`."""
    ahead, state, command = observed[:-16].reshape(-1, 4), observed[-16:-4], observed[-4:]
    return features(state, ahead + state[[0, 2, 4, 10]], command, hover)


@dataclass
class Network:
    """Two hidden layers, tanh, beside a linear map; trained by Adam on the mean squared error."""

    sizes: tuple[int, ...]
    seed: int = 0

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        pairs = list(zip(self.sizes[:-1], self.sizes[1:], strict=True))
        self.weights = [rng.normal(size=pair) / np.sqrt(pair[0]) for pair in pairs]
        self.weights.append(np.zeros((self.sizes[0] + 1, self.sizes[-1])))
        self.offsets = [np.zeros(b) for _, b in pairs]

    def __call__(self, x: Array) -> Array:
        """(K, outputs) of inputs (K, inputs)."""
        return self._layers(x)[-1] + self._linear(x)

    def _linear(self, x: Array) -> Array:
        return x @ self.weights[-1][:-1] + self.weights[-1][-1]

    def _layers(self, x: Array) -> list[Array]:
        found = [x]
        for i, (weight, offset) in enumerate(zip(self.weights[:-1], self.offsets, strict=True)):
            y = found[-1] @ weight + offset
            found.append(np.tanh(y) if i < len(self.offsets) - 1 else y)
        return found

    def fit(self, x: Array, y: Array, *, epochs: int, rate: float = 2e-3) -> float:
        """Fit the linear map, then the rest; the root mean square error."""
        whole = np.column_stack([x, np.ones(len(x))])
        self.weights[-1] = np.linalg.solve(whole.T @ whole + 1e-3 * np.eye(whole.shape[1]), whole.T @ y)
        rest, rng = y - self._linear(x), np.random.default_rng(self.seed)
        parameters = [*self.weights[:-1], *self.offsets]
        mean, square, step = [np.zeros_like(p) for p in parameters], [np.zeros_like(p) for p in parameters], 0
        for epoch in range(epochs):
            order, now = rng.permutation(len(x)), rate * 0.5 * (1.0 + np.cos(np.pi * epoch / epochs))
            for batch in np.array_split(order, max(1, len(x) // 256)):
                step += 1
                for i, slope in enumerate(self._gradient(x[batch], rest[batch])):
                    mean[i] = 0.9 * mean[i] + 0.1 * slope
                    square[i] = 0.999 * square[i] + 0.001 * slope**2
                    size = np.sqrt(square[i] / (1.0 - 0.999**step)) + 1e-8
                    parameters[i] -= now * mean[i] / (1.0 - 0.9**step) / size
        return float(np.sqrt(np.mean((self(x) - y) ** 2)))

    def _gradient(self, x: Array, y: Array) -> list[Array]:
        layers = self._layers(x)
        back = 2.0 * (layers[-1] - y) / y.size
        weights: list[Array] = []
        offsets: list[Array] = []
        for i in reversed(range(len(self.offsets))):
            weights.insert(0, layers[i].T @ back)
            offsets.insert(0, back.sum(axis=0))
            back = (back @ self.weights[i].T) * (1.0 - layers[i] ** 2)
        return [*weights, *offsets]


class Student:
    """The network as a controller: `quadsim.fly(scenario, controller=Student(...))`."""

    name, solver, horizon = "student", "", 50

    def __init__(self, network: Network, vehicle: quadsim.Vehicle) -> None:
        self.network, self.hover = network, vehicle.hover_speed

    def speeds(self, x: Array) -> Array:
        """(4,) rotor speeds [rad/s] for features (56,)."""
        found: Array = self.hover + 10.0 * self.network(x[None])[0]
        return np.clip(found, 0.0, 250.0)

    def step(self, now: quadsim.Moment, state: Array, reference: Array) -> Array:
        """See `quadsim.controller.Controller.step`."""
        assert now.acting is not None
        return self.speeds(features(state, reference, now.acting, self.hover))


def answers(
    scenario: quadsim.Scenario, hover: float, student: Student | None = None
) -> tuple[list[Array], list[Array]]:
    """Features and the teacher's rotor speeds, period by period, of its own flight or of a student's."""
    env = quadsim.gym.make_env(scenario, **OBSERVED)
    observed, _ = env.reset()
    seen, speeds, ended = [], [], False
    while not ended:
        try:
            action = env.unwrapped.controller_action()
        except FlightError:  # the teacher has no answer to where the student flew
            break
        if env.unwrapped.controller_status in ("solved", "unconstrained"):
            seen.append(of_observation(observed, hover))
            speeds.append(action)
        action = action if student is None else student.speeds(of_observation(observed, hover))
        observed, _, terminated, truncated, _ = env.step(action)
        ended = terminated or truncated
    env.close()
    return seen, speeds


def learn(*, courses: int = 12, rounds: int = 3, epochs: int = 100) -> Student:
    """A student of the paper's controller: of its own flights first, then of its labels for the student's."""
    vehicle = quadsim.load_vehicle("lopes2011")
    student, hover = Student(Network((INPUTS, 64, 64, 4)), vehicle), vehicle.hover_speed
    x, y = np.empty((0, INPUTS)), np.empty((0, 4))
    for round_ in range(rounds + 1):
        for i in range(courses):
            seen, speeds = answers(course(1000 + round_ * courses + i), hover, student if round_ else None)
            x, y = np.concatenate([x, seen]), np.concatenate([y, (np.array(speeds) - hover) / 10.0])
        error = student.network.fit(x, y, epochs=epochs)
        print(f"round {round_}: {len(x)} samples, RMS error {10.0 * error:.3f} rad/s")
    return student


def behind_filter(student: Student, scenario: quadsim.Scenario) -> quadsim.Flight:
    """The student's flight where only those commands pass after which the robust MPC can still hold 5 deg."""
    table = tomllib.loads(quadsim.load("robust").to_toml())["controller"]
    most = {"roll_rate": 30.0, "pitch_rate": 30.0, "yaw_rate": 30.0, "vz": 3.0}  # deg/s, m/s: no spin or dive
    limits = list(most.values())
    calm = {"of": list(most), "rows": np.eye(4).tolist(), "lower": [-each for each in limits], "upper": limits}
    table["polytopes"] = [{"name": "calm", **calm}]
    env = quadsim.gym.MPCSafetyFilter(quadsim.gym.make_env(scenario, **OBSERVED), table)
    observed, _ = env.reset(seed=0)
    ended = False
    while not ended:
        action = student.speeds(of_observation(observed, student.hover))
        observed, _, terminated, truncated, _ = env.step(action)
        ended = terminated or truncated
    flight: quadsim.Flight = env.unwrapped.flight()
    env.close()
    return flight


def compared(student: Student, flights: int = 20, duration: float = 30.0) -> dict[str, list[quadsim.Flight]]:
    """Teacher, student and student behind the filter, each on the same courses, which none has seen."""
    courses = [course(seed).replace({"duration": duration}) for seed in range(flights)]
    return {
        "teacher": [quadsim.fly(each, progress=False) for each in courses],
        "student": [quadsim.fly(each, controller=student, progress=False) for each in courses],
        "student behind the filter": [behind_filter(student, each) for each in courses],
    }


def beyond(flight: quadsim.Flight) -> float:
    """By how much roll or pitch is beyond 5 deg at most [deg]."""
    return max(-float(flight.margins[axis].min()) for axis in ("roll", "pitch"))


def main() -> None:
    """Learn, fly, count."""
    for name, flights in compared(learn()).items():
        broken = sum(not flight.satisfied for flight in flights)
        error = np.mean([flight.metrics[f"rmse.{axis}"] for flight in flights for axis in "xyz"])
        print(
            f"{name}: constraints broken in {broken} of {len(flights)} flights, roll or pitch beyond 5 deg by at most "
            f"{max(0.0, *map(beyond, flights)):.2f} deg; mean RMS error {error:.3f} m"
        )


if __name__ == "__main__":
    main()
