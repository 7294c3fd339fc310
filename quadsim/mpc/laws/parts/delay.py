"""A known delay from measurement to command, as `quadsim_delay.c` takes it: how late commands act."""

from __future__ import annotations

import ctypes
from dataclasses import replace

import numpy as np

from quadsim.core.mirror import Struct, fill, set_members, struct
from quadsim.mpc.laws.parts.body import body_of
from quadsim.mpc.problem.model import split_delay
from quadsim.mpc.problem.rigidbody import RigidBody
from quadsim.state import Array
from quadsim.vehicle import Vehicle

_DelayStruct = struct("quadsim_delay_numbers")
_NO_TIME = 1e-9  # [s]

Bodies = dict[str, tuple[Struct, Array]]
"""Numbers of rigid bodies, each with the array that it points to, by the names of the pointers to them."""


def make_bodies(**models: RigidBody) -> Bodies:
    """Return the numbers of rigid bodies."""
    return {name: body_of(model) for name, model in models.items()}


def adopt_sent(mine: Struct, numbers: Struct | None, its: Struct, its_numbers: Struct | None) -> None:
    """Take over the commands in force and under way, and the actuators, of another controller with like commands."""
    if numbers is None or its_numbers is None:
        return
    sent = np.array(its.sent)[: its_numbers.under_way + 1]
    age = np.arange(numbers.under_way, -1, -1)  # periods before the last command
    set_members(mine, before=its.before, rotors=its.rotors, rotors_before=its.rotors_before)
    for place, periods in enumerate(age):
        fill(mine.sent[place], sent[max(len(sent) - 1 - periods, 0)])


def delay_numbers(delay: float, model: RigidBody, vehicle: Vehicle, period: float) -> tuple[Struct, Bodies]:
    """Return a delay [s] that is not 0 for C, with the bodies that it points to; `model` may have any step."""
    under_way, late = split_delay(delay, period)
    models = {"late": replace(model, step=late), "whole": replace(model, step=period)}
    if period - late > _NO_TIME:
        models["rest"] = replace(model, step=period - late)
    bodies = make_bodies(**models)
    numbers = _DelayStruct(under_way=under_way, share=late / period, delay=delay, coefficient=vehicle.mean_coefficient)
    set_members(numbers, scale=model.scale)
    for name, (body, _) in bodies.items():
        setattr(numbers, name, ctypes.addressof(body))
    return numbers, bodies
