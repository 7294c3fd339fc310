"""The tab of a session's page that disturbs: pulls, rotor losses, wind, load, faults of sensors and of the computer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final, get_args

from quadsim.features.live.session import Disturbances
from quadsim.features.live.stage import Stage
from quadsim.features.live.widgets import BREAKS, Widgets
from quadsim.scenarios.schema.events import SensorText
from quadsim.vehicle import N_ROTORS

_BROKEN: Final = 0.4  # share of its thrust that a rotor loses by the button
_WIND: Final = 15.0  # [m/s] up to which fields take a wind
_SENSORS: Final = get_args(SensorText)
_GUST: Final = {"type": "gust", "velocity": [1.0, 0.0, 0.0], "duration": 1.0}
_MASS: Final = {"type": "mass", "factor": 1.1}
_LAG: Final = {"type": "rotor_lag", "rise": 0.01}
_FAULT: Final = {"type": "sensor_fault", "sensor": _SENSORS[0], "fault": "nan", "duration": 1.0}


def disturb(widgets: Widgets, stage: Stage, use: Callable[[str], None]) -> None:
    """Fill the tab with every event that this scenario can have; the others are disabled, with the reason.

    `use` takes a hint away.
    """
    faults = [_FAULT | {"sensor": name} for name in _SENSORS]
    no_wind, no_mass, no_lag, *no_fault = widgets.session.refusals([_GUST, _MASS, _LAG, *faults])
    _add_pull(widgets, stage, use)
    _add_rotor_losses(widgets, use)
    _add_wind(widgets, no_wind)
    _add_load(widgets, no_mass)
    _add_rotor_lag(widgets, no_lag)
    _add_sensor_faults(widgets, no_fault)
    late = widgets.gui.add_number("Late commands [ms]", 200, min=10, max=5000, step=10)
    widgets.event("Stall the computer", lambda: {"type": "stall", "duration": late.value / 1e3}, color=BREAKS)


def _add_pull(widgets: Widgets, stage: Stage, use: Callable[[str], None]) -> None:
    """Let the mouse pull the first vehicle."""

    def pulled(event: Any) -> None:
        to = None
        if event.phase != "end":
            to = [float(number) for number in event.end_position]
        widgets.session.submit({"type": "pull", "to": to}, subject="pull")
        use("pull")

    widgets.on(stage.grab.on_drag("left"), pulled)


def _add_rotor_losses(widgets: Widgets, use: Callable[[str], None]) -> None:
    """Add a button that breaks the first rotor and repairs it, and a slider for what each rotor lacks."""
    session = widgets.session
    acting = session.disturbances

    def worn() -> float:
        return float(session.disturbances.worn[0])

    def is_broken() -> bool:
        return bool(sliders[0].value > round(worn(), 4))

    def clicked(event: Any) -> None:
        use("break")
        loss = worn()
        if not is_broken():
            loss += (1.0 - loss) * _BROKEN
        widgets.give(sliders[0], round(loss, 4))

    async def changed(event: Any) -> None:  # also by a reset
        if is_broken():
            button.label = "Repair the rotor"
            button.color = None
        else:
            button.label = "Break a rotor"
            button.color = BREAKS

    hint = f"rotor 1 loses {100 * _BROKEN:.0f} % of its thrust"
    button = widgets.button("Break a rotor", clicked, hint=hint, color=BREAKS)
    sliders = []
    for rotor in range(1, N_ROTORS + 1):
        slider = widgets.gui.add_slider(f"Rotor {rotor} loss", 0.0, 1.0, 0.05, _rotor_loss(rotor, acting))
        sliders.append(widgets.shows(slider, partial(_rotor_loss, rotor), partial(_wear, rotor)))
    sliders[0].on_update(changed)


def _rotor_loss(rotor: int, acting: Disturbances) -> float:
    """Return the share of its thrust that a rotor lacks."""
    return round(float(acting.loss[rotor - 1]), 4)


def _wear(rotor: int, loss: Any, acting: Disturbances) -> dict[str, Any]:
    """Return the input by which a rotor lacks a share of its thrust; what it lacks by the scenario stays."""
    left = 1.0 - float(acting.worn[rotor - 1])
    further = 0.0
    if left > 0.0:
        further = max(0.0, 1.0 - (1.0 - float(loss)) / left)
    return {"type": "wear", "rotor": rotor, "loss": round(further, 4)}


def _add_wind(widgets: Widgets, refused: str) -> None:
    """Add a gust and the mean wind, both along the ground."""
    acting = widgets.session.disturbances
    most = max(_WIND, *map(abs, acting.wind))
    look = {"min": (-most, -most), "max": (most, most), "step": 0.5, "disabled": bool(refused)}
    gust = widgets.gui.add_vector2("Gust x, y [m/s]", (6.0, 0.0), **look)
    widgets.event("Gust for 1 s", lambda: _GUST | {"velocity": [*gust.value, 0.0]}, refused)
    widgets.shows(
        widgets.gui.add_vector2("Wind x, y [m/s]", acting.wind[:2], **look),
        lambda acting: acting.wind[:2],
        lambda value, acting: {"type": "wind", "velocity": [*value, acting.wind[2]]},
    )
    if refused:
        refused = f"No wind: {refused}"
    widgets.explain(refused)


def _add_load(widgets: Widgets, refused: str) -> None:
    """Add the factor of the mass, and a payload to take and drop."""
    factor = widgets.session.disturbances.mass_factor
    mass = widgets.session.flights[0].actual.mass
    disabled = bool(refused)
    least = min(0.7, factor)
    most = max(1.5, factor)
    widgets.shows(
        widgets.gui.add_slider("Mass factor", least, most, 0.01, factor, disabled=disabled),
        lambda acting: acting.mass_factor,
        lambda value, acting: {"type": "mass", "factor": float(value)},
    )
    step = round(0.01 * mass, 5)
    look = {"min": 0.0, "max": mass, "step": step, "disabled": disabled}
    payload = widgets.gui.add_number("Payload [kg]", round(0.1 * mass, 4), **look)
    widgets.event("Take payload", lambda: {"type": "payload_pickup", "mass": float(payload.value)}, refused)
    widgets.event("Drop payload", lambda: {"type": "payload_drop"}, refused)
    widgets.explain(refused)


def _add_rotor_lag(widgets: Widgets, refused: str) -> None:
    """Add the rotors' time constants."""
    lag = _shown_lag(widgets.session.disturbances)
    most = max(100.0, *lag)
    look = {"min": (0.0, 0.0), "max": (most, most), "step": 1.0, "disabled": bool(refused)}
    widgets.shows(
        widgets.gui.add_vector2("Rotor lag up, down [ms]", lag, **look),
        _shown_lag,
        lambda value, acting: {"type": "rotor_lag", "rise": value[0] / 1e3, "fall": value[1] / 1e3},
    )
    widgets.explain(refused)


def _shown_lag(acting: Disturbances) -> tuple[float, float]:
    """Return the rotors' time constants [ms]."""
    rise, fall = acting.lag
    return round(1e3 * rise, 3), round(1e3 * fall, 3)


def _add_sensor_faults(widgets: Widgets, refused: Sequence[str]) -> None:
    """Add the faults of the sensors that this scenario has; `refused` says of each sensor why it cannot fail."""
    present = [name for name, reason in zip(_SENSORS, refused, strict=True) if not reason]
    reason = ""
    if not present:
        reason = refused[0]
    disabled = not present
    sensor = widgets.gui.add_dropdown("Sensor", present or _SENSORS, disabled=disabled)
    fault = widgets.gui.add_dropdown("Fault", ("dropout", "freeze", "nan"), disabled=disabled)
    widgets.event(
        "Fail sensor for 1 s",
        lambda: _FAULT | {"sensor": sensor.value, "fault": fault.value},
        reason,
        color=BREAKS,
    )
    widgets.explain(reason)
