"""A commented vehicle file to fill in: every parameter, its unit, what it is, and how to measure or estimate it.

Names, units, meanings and which ones may be left out are those of `quadsim.vehicle`; added here is how to find a value,
and an example, the numbers of a 1.5 kg quadrotor with 10 inch propellers.  A parameter without either is refused.
"""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from typing import Final, get_type_hints

from annotated_types import DocInfo

from quadsim.vehicle import OPTIONAL_PARAMETERS, VEHICLE_UNITS, Vehicle

WIDTH: Final = 118


@dataclass(frozen=True, kw_only=True)
class Advice:
    """How to find a parameter."""

    value: float | list[float] | list[int]  # of the example
    how: str  # to measure or to estimate it
    without: str = ""  # what is so where it is left out; empty for one that is needed


ADVICE: Final[dict[str, Advice]] = {
    "mass": Advice(value=1.5, how="weigh it ready to fly, battery and payload included"),
    "gravity": Advice(value=9.81, how="9.81 will do anywhere on Earth"),
    "inertia": Advice(
        value=[0.0152, 0.0152, 0.0274],
        how="hang it on two parallel strings of length l, a distance d apart, about the axis of interest, twist it and "
        "time a swing T: J = m g d^2 T^2 / (16 pi^2 l) (bifilar pendulum); or from CAD; or estimate 0.2 m L^2 for x "
        "and y and 1.8 times that for z",
    ),
    "arm_length": Advice(value=0.225, how="half the distance from motor shaft to opposite motor shaft"),
    "rotor_azimuths": Advice(
        value=[-45.0, -135.0, 135.0, 45.0],
        how="in the order of your rotors; X: front right, back right, back left, front left as here; "
        "plus: 0, -90, 180, 90",
    ),
    "rotor_spins": Advice(
        value=[-1, 1, -1, 1],
        how="a rotor that turns counter-clockwise seen from above pushes the body clockwise: -1; neighbours differ",
    ),
    "thrust_coefficient": Advice(
        value=1.5e-5,
        how="on a thrust stand: the slope of thrust over speed squared; or hover, read the mean rotor speed w "
        "(rpm / 9.549), b = m g / (4 w^2); or estimate 0.1 * 1.225 * 16 R^4 / (4 pi^2)",
    ),
    "drag_to_thrust": Advice(
        value=0.017, how="on a thrust stand: torque over thrust; or estimate 0.13 of the propeller's radius"
    ),
    "speed_min": Advice(value=100.0, how="idle speed of the motors in flight, 0 where they may stop"),
    "speed_max": Advice(
        value=750.0,
        how="full throttle with the propeller on and the battery half empty (rpm / 9.549); or estimate three quarters "
        "of kV times voltage",
    ),
    "rotor_rise": Advice(
        value=0.05,
        how="log the speed after a step of throttle near hover: time to 63 % of the change; 10 to 30 ms for 5 inch, "
        "40 to 80 ms for 10 inch, above 100 ms for 20 inch propellers",
        without="rotors follow commands at once in simulation, and the controller predicts no lag",
    ),
    "rotor_fall": Advice(
        value=0.06,
        how="the same after a step down; somewhat longer where the motors do not brake",
        without="as rotor_rise, at once",
    ),
    "rotor_inertia": Advice(
        value=8e-5,
        how="the propeller as a thin rod, m R^2 / 3 of its mass and radius, and the motor's bell m r^2",
        without="no gyroscopic and spin-up torques",
    ),
    "rotor_radius": Advice(
        value=0.127, how="half the propeller's diameter; 10 inch are 0.254 m", without="no ground effect"
    ),
    "rotor_drag": Advice(
        value=5e-5,
        how="fly level at a steady small speed v and read the tilt: m g tan(tilt) / (4 w v), w the hover speed; or "
        "estimate 0.2 m / (4 w)",
        without="no drag of the rotors",
    ),
    "body_drag": Advice(
        value=[0.015, 0.015, 0.03],
        how="drag coefficient, about 1, times the area seen from the front, the side and above",
        without="no drag of the body",
    ),
    "extent": Advice(
        value=0.36,
        how="measure from the centre of mass to what reaches farthest, propellers and feet included",
        without="among obstacles it reaches to its propellers' tips: arm_length and rotor_radius",
    ),
}
"""By parameter; the same ones as `quadsim.vehicle.VEHICLE_UNITS`, or the import fails."""
assert list(ADVICE) == list(VEHICLE_UNITS), set(ADVICE) ^ set(VEHICLE_UNITS)
assert {name for name, advice in ADVICE.items() if advice.without} == set(OPTIONAL_PARAMETERS)


def vehicle_template() -> str:
    """The file, a valid vehicle that flies."""
    meanings = parameter_meanings()
    lines = [
        "# A vehicle file for quadsim. The numbers are an example, a quadrotor of 1.5 kg with 10 inch propellers:",
        "# replace each by yours, and its source by where yours is from. Then:",
        "#   quadsim vehicle mine.toml                                       what it can do",
        "#   quadsim scenario --for mine.toml --course figure-eight > first.toml",
        "#   quadsim run first.toml",
        "# Body frame: x forward, y left, z up, origin at the centre of mass.",
        "",
        'name = "mine"',
        'description = "An example: 1.5 kg quadrotor, X, 10 inch propellers"',
    ]
    for name, unit in VEHICLE_UNITS.items():
        advice = ADVICE[name]
        lines += ["", *_comment(f"{name}: {meanings[name]}"), *_comment(f"Find it: {advice.how}.")]
        if advice.without:
            lines += _comment(f"May be left out: {advice.without}.")
        lines += [f"[{name}]", f"value = {advice.value!r}", f'unit = "{unit}"', 'source = "example"']
    return "\n".join(lines) + "\n"


def parameter_meanings() -> dict[str, str]:
    """What each parameter is, from its declaration in `quadsim.vehicle.Vehicle`."""
    hints = get_type_hints(Vehicle, include_extras=True)
    return {
        name: note.documentation.partition("] ")[2]
        for name in VEHICLE_UNITS
        for note in hints[name].__metadata__
        if isinstance(note, DocInfo)
    }


def _comment(text: str) -> list[str]:
    return [f"# {line}" for line in textwrap.wrap(text, WIDTH)]
