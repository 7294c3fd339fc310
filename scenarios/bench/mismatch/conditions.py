"""The conditions of `quadsim bench ladder`, as settings of a scenario, and which parameters controllers know."""

from __future__ import annotations

from typing import Final, NamedTuple

WORN: Final = 0.2  # share of its thrust and torque that the worn rotor loses


class Condition(NamedTuple):
    """One mismatch between the plant and the controller's model."""

    about: str  # in a line
    settings: tuple[str, ...] = ()  # of the scenario file, by dotted paths
    rotor_lag: float = 0.0  # time constant that controllers with a model of it assume [s]; 0 for none
    delay: float = 0.0  # computation time that they assume [s]


def _lag(seconds: float) -> tuple[str, ...]:
    return (f"effects.rotors.rise={seconds}", f"effects.rotors.fall={seconds}")


def _wind(share: float) -> tuple[str, ...]:
    """Wind along x with light Dryden turbulence; the drag is about that of the Hummingbird's propellers in RotorS."""
    turbulence = f"turbulence={{wind_speed_20ft={7.7 * share}}}"
    return (f"effects.air={{rotor_drag=3e-4, wind=[{3.0 * share}, 0.0, 0.0], {turbulence}}}",)


def _noise(share: float) -> tuple[str, ...]:
    deviations = {"position": 0.01, "velocity": 0.05, "attitude": 0.26, "rates": 0.3}
    return tuple(f"sensors.{name}={{rate=100, noise={size * share}}}" for name, size in deviations.items())


def _worn(share: float) -> tuple[str, ...]:
    return (f"events=[{{type='rotor_loss', at=12.0, rotor=2, loss={WORN * share}}}]",)


CONDITIONS: Final = {
    "nominal": Condition("the paper's model, but for its linearisation"),
    **{
        f"lag {1e3 * lag:g} ms": Condition(
            f"rotors with a time constant of {1e3 * lag:g} ms; models of lag assume 50 ms", _lag(lag), rotor_lag=0.05
        )
        for lag in (0.01, 0.02, 0.05, 0.08)
    },
    "mass +30 %": Condition("30 % heavier than modelled", ("effects.load.mass_factor=1.3",)),
    "mass -30 %": Condition("30 % lighter than modelled", ("effects.load.mass_factor=0.7",)),
    "wind 3 m/s": Condition(
        "3 m/s along x with Dryden turbulence, 7.7 m/s at 20 ft; rotor drag of 3e-4 kg/rad", _wind(1.0)
    ),
    "sensor noise": Condition(
        "100 Hz, no estimator; position 0.01 m, velocity 0.05 m/s, attitude 0.26 deg, rates 0.3 deg/s, one standard "
        "deviation",
        _noise(1.0),
    ),
    "worn rotor": Condition(f"rotor 2 loses {100 * WORN:g} % of thrust and torque at 12 s, permanently", _worn(1.0)),
    "yaw 180 deg": Condition(
        "starts half a turn away from the heading that it is to have", ("initial.euler=[0.0, 0.0, 180.0]",)
    ),
    **{
        f"delay {1e3 * delay:g} ms": Condition(
            f"commands act {1e3 * delay:g} ms after the measurement; known to models of delay",
            (f"computation.delay={delay}",),
            delay=delay,
        )
        for delay in (0.02, 0.05)
    },
    "all by half": Condition(
        "lag 25 ms, known; mass +15 %; wind 1.5 m/s with turbulence; half the noise; rotor 2 loses 10 %; yaw 90 deg; "
        "commands 10 ms late, known",
        (
            *(*_lag(0.025), "effects.load.mass_factor=1.15", *_wind(0.5), *_noise(0.5), *_worn(0.5)),
            *("initial.euler=[0.0, 0.0, 90.0]", "computation.delay=0.01"),
        ),
        rotor_lag=0.025,
        delay=0.01,
    ),
}
"""By their names in tables, in order."""
QUICK_CONDITIONS: Final = ("nominal", "lag 80 ms", "mass +30 %")
