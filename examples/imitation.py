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
"""States that the student sees: velocities, roll, pitch and all rates; the preview is relative to position and yaw."""
TOLERANCE = 0.2  # deg, of roll and pitch
PREVIEW = 50  # periods
INPUTS = 4 * PREVIEW + len(MOVING) + 5


def course(seed: int) -> quadsim.Scenario:
    """Steps of 2 to 5 m along each axis at random times, and a start at a random yaw."""
    rng = np.random.default_rng(seed)
    yaw = float(rng.uniform(-30.0, 30.0))
    changes: dict[str, object] = {"initial.euler": [0.0, 0.0, yaw], "duration": 30.0}
    for axis in "xyz":
        start = rng.uniform(0.0, 8.0)
        size = rng.uniform(2.0, 5.0) * rng.choice([-1.0, 1.0])
        changes[f"reference.{axis}"] = [{"start": float(start), "stop": float(start + 10.0), "value": float(size)}]
    for axis in ("roll", "pitch"):  # between samples, and beyond the linear model, the teacher is off by some 0.1 deg
        changes[f"constraints.{axis}.tolerance"] = TOLERANCE
        changes[f"constraints.{axis}.tolerance_sampled"] = TOLERANCE
    scenario = quadsim.load("paper-constrained").replace(changes)
    return scenario.altered(constraints=[limit for limit in scenario.constraints if "arrival" not in limit.name])


def features(now: quadsim.StepInputs, state: Array, preview: Array, hover: float) -> Array:
    """Return the student's inputs (213,): of a state (12,), a reference (50, 4) and the command in force, and a one."""
    assert now.acting is not None
    ahead = (preview - state[[0, 2, 4, 10]]).ravel()
    return np.concatenate([ahead, state[MOVING], (now.acting - hover) / 10.0, [1.0]])


class Student:
    """A linear map as a controller: `quadsim.fly(scenario, controller=Student(...))`."""

    name = "student"
    solver = ""
    horizon = PREVIEW

    def __init__(self, gain: Array, hover: float) -> None:
        self.gain = gain
        self.hover = hover

    def step(self, now: quadsim.StepInputs, state: Array, reference: Array) -> Array:
        """See `quadsim.controller.Controller.step`."""
        speeds = self.hover + features(now, state, reference, self.hover) @ self.gain
        return np.clip(speeds, 0.0, 250.0)


class Lesson:
    """The teacher as a controller that writes down what it does, and lets a student fly if there is one."""

    name = "lesson"
    solver = ""
    horizon = PREVIEW

    def __init__(self, scenario: quadsim.Scenario, hover: float, student: Student | None = None) -> None:
        self.teacher = quadsim.make_controller(scenario)
        self.hover = hover
        self.student = student
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
        if self.student is None:
            return command
        return self.student.step(now, state, reference)


def learn(*, courses: int = 6, rounds: int = 1) -> Student:
    """A student of the paper's controller: of its own flights first, then of its labels for the student's."""
    hover = quadsim.load_vehicle("lopes2011").hover_speed
    student: Student | None = None
    seen: list[Array] = []
    speeds: list[Array] = []
    for i in range(courses * (rounds + 1)):
        scenario = course(1000 + i)
        lesson = Lesson(scenario, hover, student)
        quadsim.fly(scenario, controller=lesson, progress=False)  # which ends where the teacher has no answer
        seen += lesson.seen
        speeds += lesson.speeds
        if (i + 1) % courses == 0:
            x = np.array(seen)
            y = np.array(speeds) - hover
            gain = np.linalg.solve(x.T @ x + 1e-3 * np.eye(INPUTS), x.T @ y)
            student = Student(gain, hover)
            error = np.sqrt(np.mean((x @ student.gain - y) ** 2))
            print(f"{len(x)} samples, RMS error {error:.3f} rad/s")
    assert student is not None
    return student


def behind_filter(student: Student, scenario: quadsim.Scenario) -> quadsim.Flight:
    """The student's flight where only those commands pass after which the robust MPC can still hold 5 deg."""
    table = tomllib.loads(quadsim.load("robust").to_toml())["controller"]
    calm = {  # no spin or dive
        "name": "calm",
        "of": ["roll_rate", "pitch_rate", "yaw_rate", "vz"],
        "rows": np.eye(4).tolist(),
        "lower": [-30.0, -30.0, -30.0, -3.0],  # deg/s, m/s
        "upper": [30.0, 30.0, 30.0, 3.0],
    }
    table["polytopes"] = [calm]
    env = quadsim.gym.MPCSafetyFilter(quadsim.gym.make_env(scenario, action="speeds"), table)
    env.reset(seed=0)
    started = env.unwrapped.started
    ended = False
    while not ended:
        now = started.observation
        action = student.step(now.moment, now.state, now.preview)
        _, _, terminated, truncated, _ = env.step(action)
        ended = terminated or truncated
    flight: quadsim.Flight = env.unwrapped.flight()
    env.close()
    return flight


def compared(student: Student, flights: int = 20, duration: float = 30.0) -> dict[str, list[quadsim.Flight]]:
    """Teacher, student and student behind the filter, each on the same courses, which none has seen."""
    courses = [course(seed).replace({"duration": duration}) for seed in range(flights)]
    by_teacher = [quadsim.fly(scenario, progress=False) for scenario in courses]
    by_student = [quadsim.fly(scenario, controller=student, progress=False) for scenario in courses]
    filtered = [behind_filter(student, scenario) for scenario in courses]
    return {"teacher": by_teacher, "student": by_student, "student behind the filter": filtered}


def beyond(flight: quadsim.Flight) -> float:
    """Return by how much roll or pitch is beyond 5 deg at most [deg]."""
    roll = -float(flight.margins["roll"].min())
    pitch = -float(flight.margins["pitch"].min())
    return max(roll, pitch)


def main() -> None:
    """Learn, fly, count."""
    for name, flights in compared(learn()).items():
        violated = 0
        worst = 0.0
        errors = []
        for flight in flights:
            if not flight.satisfied:
                violated += 1
            worst = max(worst, beyond(flight))
            for axis in "xyz":
                errors.append(flight.metrics[f"rmse.{axis}"])
        print(
            f"{name}: constraints violated in {violated} of {len(flights)} flights, roll or pitch beyond 5 deg by at "
            f"most {worst:.2f} deg; mean RMS error {np.mean(errors):.3f} m"
        )


if __name__ == "__main__":
    main()
