"""A network imitates the paper's controller, and is audited like it: `python examples/imitation.py`, two minutes.

The teacher flies courses of random steps, the student learns its commands by least squares, then flies itself while the
teacher labels them with its own actions (data aggregation: Ross, Gordon and Bagnell, 2011, "A reduction of imitation
learning and structured prediction to no-regret online learning").  Both then fly courses that neither has seen.
"""

from __future__ import annotations

import itertools
import tomllib

import numpy as np
import scipy
from numpy.typing import NDArray

import quadsim
import quadsim.gym

Array = NDArray[np.float64]

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


class Network:
    """A linear map, and two hidden layers of tanh for what that leaves: least squares, then L-BFGS."""

    def __init__(self, *sizes: int) -> None:
        rng, self.shapes = np.random.default_rng(0), [(a + 1, b) for a, b in itertools.pairwise(sizes)]
        self.linear: Array = np.zeros((sizes[0] + 1, sizes[-1]))
        self.weights = np.concatenate([(rng.normal(size=shape) / np.sqrt(shape[0])).ravel() for shape in self.shapes])

    def __call__(self, x: Array) -> Array:
        """(K, outputs) of inputs (K, inputs)."""
        return with_ones(x) @ self.linear + self.layers(x, self.weights)[-1]

    def matrices(self, weights: Array) -> list[Array]:
        """The layers' matrices, the offsets in their last rows."""
        ends = np.cumsum([a * b for a, b in self.shapes])[:-1]
        return [part.reshape(shape) for part, shape in zip(np.split(weights, ends), self.shapes, strict=True)]

    def layers(self, x: Array, weights: Array) -> list[Array]:
        """The inputs, and what comes out of each layer."""
        found = [x]
        for matrix in self.matrices(weights):
            found.append(with_ones(np.tanh(found[-1]) if len(found) > 1 else x) @ matrix)
        return found

    def error(self, weights: Array, x: Array, y: Array) -> tuple[float, Array]:
        """The mean squared error of the layers, and its gradient."""
        layers = self.layers(x, weights)
        back, slopes = 2.0 * (layers[-1] - y) / y.size, []
        for i, matrix in reversed(list(enumerate(self.matrices(weights)))):
            inputs = np.tanh(layers[i]) if i else x
            slopes.append((with_ones(inputs).T @ back).ravel())
            back = (back @ matrix[:-1].T) * (1.0 - inputs**2)
        return float(np.mean((layers[-1] - y) ** 2)), np.concatenate(slopes[::-1])

    def fit(self, x: Array, y: Array, steps: int) -> float:
        """Fit the linear map, then the rest; the root mean square error."""
        self.linear = np.asarray(np.linalg.lstsq(with_ones(x), y)[0], float)
        rest = x, y - with_ones(x) @ self.linear
        found = scipy.optimize.minimize(
            self.error, self.weights, rest, jac=True, method="L-BFGS-B", options={"maxiter": steps}
        )
        self.weights = found.x
        return float(np.sqrt(found.fun))


def with_ones(x: Array) -> Array:
    """Inputs (K, n) with a column of ones, whose weights are the offsets."""
    return np.column_stack([x, np.ones(len(x))])


class Student:
    """The network as a controller: `quadsim.fly(scenario, controller=Student(...))`."""

    name, solver, horizon = "student", "", 50

    def __init__(self, network: Network, vehicle: quadsim.Vehicle) -> None:
        self.network, self.hover = network, vehicle.hover_speed

    def step(self, now: quadsim.Moment, state: Array, reference: Array) -> Array:
        """See `quadsim.controller.Controller.step`."""
        assert now.acting is not None
        found: Array = self.hover + 10.0 * self.network(features(state, reference, now.acting, self.hover)[None])[0]
        return np.clip(found, 0.0, 250.0)


class Lesson:
    """The teacher as a controller that writes down what it does, and lets a student fly if there is one."""

    name, solver, horizon = "lesson", "", 50

    def __init__(self, scenario: quadsim.Scenario, student: Student | None = None) -> None:
        self.teacher, self.student = quadsim.make_controller(scenario), student
        self.hover = quadsim.load_vehicle("lopes2011").hover_speed
        self.seen: list[Array] = []
        self.speeds: list[Array] = []

    def reset(self, speeds: Array) -> None:
        """See `quadsim.controller.Controller.reset`."""
        self.teacher.reset(speeds)

    def step(self, now: quadsim.Moment, state: Array, reference: Array) -> quadsim.Command | Array:
        """See `quadsim.controller.Controller.step`."""
        assert now.acting is not None
        command = self.teacher.step(now, state, reference)
        if command.status in ("solved", "unconstrained"):
            self.seen.append(features(state, reference, now.acting, self.hover))
            self.speeds.append(command.speeds)
        return command if self.student is None else self.student.step(now, state, reference)


def learn(*, courses: int = 12, rounds: int = 3, steps: int = 150) -> Student:
    """A student of the paper's controller: of its own flights first, then of its labels for the student's."""
    vehicle = quadsim.load_vehicle("lopes2011")
    student = Student(Network(INPUTS, 64, 64, 4), vehicle)
    seen: list[Array] = []
    speeds: list[Array] = []
    for round_ in range(rounds + 1):
        for i in range(courses):
            flown = course(1000 + round_ * courses + i)
            lesson = Lesson(flown, student if round_ else None)
            quadsim.fly(flown, controller=lesson, progress=False)  # which ends where the teacher has no answer
            seen, speeds = seen + lesson.seen, speeds + lesson.speeds
        error = student.network.fit(np.array(seen), (np.array(speeds) - vehicle.hover_speed) / 10.0, steps)
        print(f"round {round_}: {len(seen)} samples, RMS error {10.0 * error:.3f} rad/s")
    return student


def behind_filter(student: Student, scenario: quadsim.Scenario) -> quadsim.Flight:
    """The student's flight where only those commands pass after which the robust MPC can still hold 5 deg."""
    table = tomllib.loads(quadsim.load("robust").to_toml())["controller"]
    most = {"roll_rate": 30.0, "pitch_rate": 30.0, "yaw_rate": 30.0, "vz": 3.0}  # deg/s, m/s: no spin or dive
    limits = list(most.values())
    calm = {"of": list(most), "rows": np.eye(4).tolist(), "lower": [-each for each in limits], "upper": limits}
    table["polytopes"] = [{"name": "calm", **calm}]
    env = quadsim.gym.MPCSafetyFilter(quadsim.gym.make_env(scenario, action="speeds"), table)
    env.reset(seed=0)
    started, ended = env.unwrapped.started, False
    while not ended:
        now = started.observation
        _, _, terminated, truncated, _ = env.step(student.step(now.moment, now.state, now.preview))
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
