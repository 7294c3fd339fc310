"""Numbers as C99 text, the same for the same numbers."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from quadsim.state import Array

LEAST_FLOAT: Final = 1.2e-38
"""Magnitude below which a number is 0: single precision would truncate it, which is an error of some compilers."""
NO_BOUND: Final = 1e30
"""In place of infinity."""


def number(value: float) -> str:
    """A number of the exported precision, e.g. `-R(1.5)`; the compiler rounds it once.

    Raises:
        ValueError: it is not finite.
    """
    if not np.isfinite(value):
        raise ValueError(f"{value} has no place in C")
    if abs(value) < LEAST_FLOAT:
        return "R(0.0)"
    text = repr(abs(float(value)))
    return f"{'-' if value < 0.0 else ''}R({text})"


def bounded(values: Array) -> Array:
    """Bounds with `NO_BOUND` for infinity."""
    return np.clip(values, -NO_BOUND, NO_BOUND)


def reals(name: str, values: ArrayLike) -> str:
    """A constant array of numbers, row by row; of one zero where there are none."""
    return _array("real", name, [number(value) for value in np.ravel(values).tolist()] or ["R(0.0)"])


def small_integers(name: str, values: Sequence[int]) -> str:
    """A constant array of integers of 0 to 255; of one zero where there are none."""
    return _array("unsigned char", name, [str(value) for value in values] or ["0"])


def _array(kind: str, name: str, entries: list[str]) -> str:
    lines = textwrap.wrap(", ".join(entries), 116, break_long_words=False, break_on_hyphens=False)
    body = "\n".join(f"    {line}" for line in lines)
    return f"static const {kind} {name}[{len(entries)}] = {{\n{body}\n}};\n"


def lower_packed(matrix: Array) -> Array:
    """The lower part of a symmetric matrix, row by row."""
    return np.asarray(matrix[np.tril_indices(len(matrix))])


def structs(kind: str, name: str, entries: Iterable[str]) -> str:
    """A constant array of structs."""
    listed = list(entries)
    body = ",\n".join(f"    {{{entry}}}" for entry in listed)
    return f"static const struct {kind} {name}[{len(listed)}] = {{\n{body}\n}};\n"
