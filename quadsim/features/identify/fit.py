"""The fit of flight logs: every parameter with its interval, and the vehicle with those that are identified.

Two searches follow one another.  The first finds every number and its interval; the second finds the numbers that pass
their gates once more, the others held at what the vehicle file will say of them, so that the file is one fit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from quadsim.errors import InputError
from quadsim.features.identify.disturbance import with_disturbance
from quadsim.features.identify.estimate import VECTORS, FlightNumbers, Identification, number_in
from quadsim.features.identify.judgement import DAMPING, JudgedFit, is_body
from quadsim.features.identify.model import Segment, mean_voltage, prepare_segment
from quadsim.features.identify.record import Record, part_of
from quadsim.features.identify.rotor_response import RotorResponse, response_speeds, rotor_response
from quadsim.features.identify.search import DRAG_AREAS, FLAT_BODY, Search
from quadsim.state import Array
from quadsim.vehicle import VEHICLE_UNITS, Vehicle


def identify_records(
    records: Sequence[Record], spans: Sequence[Sequence[slice]], vehicle: Vehicle, *, wind: bool = False
) -> Identification:
    """Identify a vehicle from the parts of records that fly; its mass, arms and layout are taken as they are.

    Args:
        records: logs of one vehicle.
        spans: of each, the parts that fly.
        vehicle: the start.
        wind: whether wind is searched for where the position is logged; it always is where only a velocity is.

    Raises:
        InputError: nothing flies, or the records differ in what they say of rotors and battery.
        ParameterError: what was identified makes no vehicle, such as one that cannot hover.
    """
    flown = _flown(records, spans)
    wind = wind or any(record.position is None or record.inertial for record in records)  # or its velocity drifts
    response: Mapping[str, RotorResponse] = {}
    if records[0].speeds is not None and (records[0].commands is not None or records[0].throttle is not None):
        response, flown = _with_instruments(flown, vehicle)

    def run_search(fixed: Mapping[str, float], initial: Search | None = None) -> Search:
        search = Search(flown, vehicle, wind=wind, fixed=fixed)
        if initial is not None:
            search.adopt(initial)
        search.run()
        return search

    search = run_search({})
    judgement = JudgedFit(search, response)
    negative = _negative_damping(search)
    while negative:  # it would absorb an error of the lag
        search = run_search({**search.fixed, **negative}, search)
        judgement = JudgedFit(search, response, judgement)
        negative = _negative_damping(search)
    held = judgement.held()
    refined = run_search(held, search)
    refused = _impossible(refined) | judgement.refuse_moved(refined)
    while refused:
        held |= refused
        refined = run_search(held, refined)
        refused = _impossible(refined) | judgement.refuse_moved(refined)
    return with_disturbance(_result(judgement, refined), refined)


def _flown(records: Sequence[Record], spans: Sequence[Sequence[slice]]) -> list[Segment]:
    """The segments of all records that fly."""
    flown = []
    for flight, (record, spans_of_record) in enumerate(zip(records, spans, strict=True)):
        for span in spans_of_record:
            flown.append(prepare_segment(part_of(record, span), flight))
    if {segment.flight for segment in flown} != {*range(len(records))}:
        raise InputError("no part of the logs flies")
    logged = {(record.speeds is None, record.commands is None, record.voltage is None) for record in records}
    if len(logged) > 1:
        names = ", ".join(record.name for record in records)
        raise InputError(f"logs fitted together must have the same columns of rotors and battery; got {names}")
    return flown


def _with_instruments(flown: Sequence[Segment], vehicle: Vehicle) -> tuple[dict[str, RotorResponse], list[Segment]]:
    """The rotors' response, and the segments with the speeds that it and the commands predict."""
    voltage = mean_voltage(flown)
    response = rotor_response(flown, vehicle, voltage)
    instrumented = []
    for segment in flown:
        speeds = response_speeds(segment, vehicle, voltage, response)
        instrumented.append(replace(segment, instrument_speeds=speeds))
    return response, instrumented


def _negative_damping(search: Search) -> dict[str, float]:
    """Sought numbers that would drive a motion instead of slowing it, each with the 0 to hold it at."""
    parameters = search.parameters(search.x, 0)
    values = dict(zip(DAMPING, (*parameters.rate_damping, parameters.inflow), strict=True))
    searched = search.names
    return {name: 0.0 for name, value in values.items() if value < 0.0 and name in searched}


def _impossible(search: Search) -> dict[str, float]:
    """Numbers that were found and make no vehicle, with what takes their place: they are to be held at it."""
    held = _negative_damping(search)
    inertia = search.parameters(search.x, 0).inertia.tolist()
    flat = FLAT_BODY * (inertia[0] + inertia[1])
    if not is_body(inertia) and search.fixed.get("inertia_z") != flat:
        held["inertia_z"] = flat
    return held


def _result(judgement: JudgedFit, refined: Search) -> Identification:
    """Every estimate, and the vehicle with those that are not refused."""
    parameters = refined.parameters(refined.x, 0)
    values, moved = judgement.moved_to(refined)
    estimates = {**judgement.estimates, **moved}.values()
    flights = tuple(_flight_numbers(refined, flight) for flight in range(refined.flight_count))
    delays, offsets, winds = zip(*flights, strict=True)

    def of_response(name: str, searched: float) -> float:
        """What measured speeds show of the response to throttle and voltage, else what was searched for."""
        estimate = judgement.estimates.get(name)
        if not judgement.speeds_measured or estimate is None or estimate.refused:
            return searched
        return estimate.value

    return Identification(
        estimates=tuple(estimates),
        vehicle=_vehicle(judgement, values),
        delay=float(np.mean(delays)),
        offset=tuple(np.mean(offsets, axis=0).tolist()),
        wind=tuple(np.mean(winds, axis=0).tolist()),
        flights=flights,
        throttle_curve=of_response("throttle_curve", parameters.throttle_curve),
        voltage_exponent=of_response("voltage_exponent", parameters.voltage_exponent),
        voltage=refined.voltage or None,
        yaw_trim=parameters.yaw_trim,
        whiteness=judgement.intervals.autocorrelation,
    )


def _flight_numbers(refined: Search, flight: int) -> FlightNumbers:
    """The numbers of a flight's own, its wind in the mean."""
    numbers = []
    winds = []
    for i, segment in enumerate(refined.segments):
        if segment.flight == flight:
            parameters = refined.parameters(refined.x, i)
            numbers.append(parameters)
            winds.append(parameters.wind.mean(axis=0))
    wind = np.mean(winds, axis=0)
    return FlightNumbers(numbers[0].delay, tuple(numbers[0].offset.tolist()), tuple(wind.tolist()))


def _vehicle(judgement: JudgedFit, values: Mapping[str, float]) -> Vehicle:
    """The start's vehicle with other values; a vector that the start lacks is there if a number of it is known."""
    start = judgement.vehicle
    known = {"inertia_z"}  # which may have to suit the others
    for name, estimate in judgement.estimates.items():
        if estimate.in_file and (not estimate.refused or name in judgement.refitted):
            known.add(name)
    changes: dict[str, Any] = {}
    for name in known:
        if name in VEHICLE_UNITS and name != "body_drag" and name in values:
            changes[name] = values[name]
    for field, axes in VECTORS.items():
        vector = []
        is_known = False
        for axis in axes:
            name = f"{field}_{axis}"
            vector.append(values.get(name, number_in(start, name) or 0.0))
            is_known = is_known or name in known
        if is_known:
            changes[field] = tuple(vector)
    if "body_drag" in known:
        areas: Array = np.array(start.body_drag or DRAG_AREAS)
        changes["body_drag"] = tuple((values["body_drag"] * areas / areas[0]).tolist())
    if "thrust_coefficient" in changes:
        changes |= {"thrust_of_speed": None, "thrust_of_throttle": None}
    return replace(start, **changes)
