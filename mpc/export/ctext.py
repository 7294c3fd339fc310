"""Constants as C99 text, the same for the same numbers."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike

from mpc.core.solver import NO_BOUND, TINY
from quadsim.state import Array

Precision = Literal["double", "float"]
LEAST_FLOAT: Final = 1.2e-38
"""Magnitude below which a number is 0: single precision would truncate it, which is an error of some compilers."""


@dataclass(frozen=True)
class CText:
    """Constants whose numbers are of a precision, and whose names all begin with `prefix`."""

    precision: Precision
    prefix: str = ""

    def number(self, value: float) -> str:
        """A number, e.g. `-1.5F`; the compiler rounds it once.

        Raises:
            ValueError: it is not finite.
        """
        if not np.isfinite(value):
            raise ValueError(f"{value} has no place in C")
        text = "0.0" if abs(value) < LEAST_FLOAT else repr(float(value))
        return text if self.precision == "double" else f"{text}F"

    def value(self, value: float | Array) -> str:
        """An initialiser of an integer, a number, or an array of these, row by row."""
        if isinstance(value, np.ndarray):
            return "{" + ", ".join(map(self.number, value.ravel().tolist())) + "}"
        return str(value) if isinstance(value, int) else self.number(value)

    def reals(self, name: str, values: ArrayLike) -> str:
        """A constant array of numbers, row by row; of one zero where there are none."""
        numbers = np.ravel(np.asarray(values, float)).tolist() or [0.0]
        return self._array("quadsim_real", name, map(self.number, numbers))

    def small_integers(self, name: str, values: Iterable[int]) -> str:
        """A constant array of integers of 0 to 255; of one zero where there are none."""
        return self._array("unsigned char", name, map(str, [*values] or [0]))

    def struct(self, kind: str, name: str, **members: object) -> str:
        """A constant struct, by names of members."""
        wrap = textwrap.TextWrapper(120, initial_indent="    ", subsequent_indent="        ")
        lines = [wrap.fill(f".{member} = {value},") for member, value in members.items()]
        return "\n".join([f"static const {kind} {name} = {{", *lines, "};\n"])

    def structs(self, kind: str, name: str, entries: Iterable[str]) -> str:
        """A constant array of structs, each an initialiser; of one of zeros where there are none."""
        listed = [*entries] or ["{0}"]
        body = ",\n".join(f"    {entry}" for entry in listed)
        return f"static const {kind} {self.prefix}{name}[{len(listed)}] = {{\n{body}\n}};\n"

    def _array(self, kind: str, name: str, entries: Iterable[str]) -> str:
        listed = [*entries]
        lines = textwrap.wrap(", ".join(listed), 116, break_long_words=False, break_on_hyphens=False)
        body = "\n".join(f"    {line}" for line in lines)
        return f"static const {kind} {self.prefix}{name}[{len(listed)}] = {{\n{body}\n}};\n"


def initialiser(**members: object) -> str:
    """Of a struct, by names of members."""
    return "{" + ", ".join(f".{name} = {value}" for name, value in members.items()) + "}"


def bounded(values: Array) -> Array:
    """Bounds with `NO_BOUND` for infinity."""
    return np.clip(values, -NO_BOUND, NO_BOUND)


def lower_packed(matrix: Array) -> Array:
    """The lower part of a symmetric matrix, row by row, without products of rounding."""
    packed = matrix[np.tril_indices(len(matrix))]
    return np.where(np.abs(packed) < TINY * np.abs(packed).max(initial=0.0), 0.0, packed)
