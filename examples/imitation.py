"""A linear map imitates the paper's controller, and is audited like it: `python examples/imitation.py`, two minutes.

The teacher flies courses of random steps, the student learns its commands by least squares, then flies itself while the
teacher labels them with its own actions (data aggregation: Ross, Gordon and Bagnell, 2011, "A reduction of imitation
learning and structured prediction to no-regret online learning").  Both then fly courses that neither has seen.
"""

from __future__ import annotations

import tomllib
from typing import Any

import numpy as np
from numpy.typing import NDArray

import quadsim
import quadsim.gym

Array = NDArray[Any]

MOVING = [1, 3, 5, 6, 7, 8, 9, 11]
"""States that the student sees: velocities, roll, pitch and all rates; place and yaw are in what lies ahead."""
TOLERANCE = 0.2  # deg, of roll and pitch
PREVIEW = 50  # periods
INPUTS = 4 * PREVIEW + len(MOVING) + 5


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
    return every.altered(constraints=[each for each in every.constraints if "arrival" not in each.name])


def features(now: quadsim.StepInputs, state: Array, preview: Array, hover: float) -> Array:
    """(213,) what the student knows: a state (12,), a reference (50, 4), the command in force, and a one."""
    assert now.acting is not None
    ahead = (preview - state[[0, 2, 4, 10]]).ravel()
    return np.concatenate([ahead, state[MOVING], (now.acting - hover) / 10.0, [1.0]])


class Student:
    """A linear map as a controller: `quadsim.fly(scenario, controller=Student(...))`."""

    name, solver, horizon = "student", "", PREVIEW

    def __init__(self, gain: Array, hover: float) -> None:
        self.gain, self.hover = gain, hover

    def step(self, now: quadsim.StepInputs, state: Array, reference: Array) -> Array:
        """See `quadsim.controller.Controller.step`."""
        return np.clip(self.hover + features(now, state, reference, self.hover) @ self.gain, 0.0, 250.0)


class Lesson:
    """The teacher as a controller that writes down what it does, and lets a student fly if there is one."""

    name, solver, horizon = "lesson", "", PREVIEW

    def __init__(self, scenario: quadsim.Scenario, hover: float, student: Student | None = None) -> None:
        self.teacher, self.hover, self.student = quadsim.make_controller(scenario), hover, student
        self.seen: list[Array] = []
        self.speeds: list[Array] = []

    def reset(self, speeds: Array) -> None:
        """See `quadsim.controller.Controller.reset`."""
        self.teacher.reset(speeds)

    def step(self, now: quadsim.StepInputs, state: Array, reference: Array) -> quadsim.Command | Array:
        """See `quadsim.controller.Controller.step`."""
        command = self.teacher.step(now, state, reference)
        if command.status in ("solved", "unconstrained"):
            self.seen.append(features(now, state, reference, self.hover))
            self.speeds.append(command.speeds)
        return command if self.student is None else self.student.step(now, state, reference)


def learn(*, courses: int = 6, rounds: int = 1) -> Student:
    """A student of the paper's controller: of its own flights first, then of its labels for the student's."""
    hover = quadsim.load_vehicle("lopes2011").hover_speed
    student: Student | None = None
    seen: list[Array] = []
    speeds: list[Array] = []
    for i in range(courses * (rounds + 1)):
        flown = course(1000 + i)
        lesson = Lesson(flown, hover, student)
        quadsim.fly(flown, controller=lesson, progress=False)  # which ends where the teacher has no answer
        seen, speeds = seen + lesson.seen, speeds + lesson.speeds
        if (i + 1) % courses == 0:
            x, y = np.array(seen), np.array(speeds) - hover
            student = Student(np.linalg.solve(x.T @ x + 1e-3 * np.eye(INPUTS), x.T @ y), hover)
            error = np.sqrt(np.mean((x @ student.gain - y) ** 2))
            print(f"{len(x)} samples, RMS error {error:.3f} rad/s")
    assert student is not None
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
