"""Events of every kind, drawn by Hypothesis: mild enough that flights go on."""

from __future__ import annotations

from typing import Any

from hypothesis import strategies as st


def number(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high).map(lambda value: round(value, 3))


def vector(largest: float) -> st.SearchStrategy[list[float]]:
    return st.lists(number(-largest, largest), min_size=3, max_size=3)


def kind(name: str, **fields: st.SearchStrategy[Any]) -> st.SearchStrategy[dict[str, Any]]:
    return st.fixed_dictionaries({"type": st.just(name), **fields})


LASTING = number(0.001, 0.5)
SENSOR = st.sampled_from(["position", "velocity", "attitude", "rates"])
HAPPENING = st.one_of(
    kind("push", duration=LASTING, force=vector(3.0), point=vector(0.1)),
    kind("setpoint", x=number(-1.0, 1.0), yaw=number(-90.0, 90.0)),
    kind("setpoint", z=number(-0.5, 0.5)),
    kind("mass", factor=number(0.8, 1.3)),
    kind("rotor_lag", rise=number(0.0, 0.1)),
    kind("rotor_lag", rise=number(0.0, 0.1), fall=number(0.0, 0.1)),
    kind("rotor_loss", rotor=st.integers(1, 4), loss=number(0.01, 0.2), duration=LASTING),
    kind("rotor_loss", rotor=st.integers(1, 4), loss=number(0.01, 0.1)),
    kind("payload_pickup", mass=number(0.01, 0.3), position=vector(0.05)),
    kind("payload_drop"),
    kind("wind", velocity=vector(4.0)),
    kind("gust", velocity=vector(4.0), duration=LASTING),
    kind("sensor_fault", sensor=SENSOR, fault=st.sampled_from(["dropout", "freeze", "nan"]), duration=LASTING),
    kind("sensor_fault", sensor=SENSOR, fault=st.just("bias"), offset=vector(0.2), duration=LASTING),
    kind("stall", duration=LASTING),
)
"""All but a change of the controller."""
