"""Constants as C99 text: numbers, arrays, and structs that Python mirrors; equal numbers give equal text.

A double is written with the digits of Python's repr, which name it exactly; a float has the suffix F, and the compiler
rounds it once.  `source`, `nonlinear` and `geometric` write a controller's numbers by it.
"""

from __future__ import annotations

import ctypes
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np

from quadsim.core.mirror import Struct
from quadsim.mpc.solvers.core import ENTRIES
from quadsim.mpc.solvers.core_tables import NO_BOUND
from quadsim.state import Array

Precision = Literal["double", "float"]
_INTEGER_TYPES: Final = {np.dtype(np.uint8): "unsigned char", np.dtype(np.intc): "int"}
LEAST_FLOAT: Final = 1.2e-38
"""Magnitude below which a number becomes 0: some compilers reject constants that single precision would truncate."""


@dataclass(frozen=True)
class CText:
    """Constants of one precision whose names start with `prefix`."""

    precision: Precision
    prefix: str = ""

    def number(self, value: float) -> str:
        """A finite number, e.g. `-1.5F`; the compiler rounds it once."""
        if not np.isfinite(value):
            raise ValueError(f"{value} cannot be written in C")
        if abs(value) < LEAST_FLOAT:
            text = "0.0"
        else:
            text = repr(float(value))
        if self.precision == "double":
            return text
        return f"{text}F"

    def value(self, value: float | Array) -> str:
        """Return an initialiser of an integer, a number, or an array of these, row by row."""
        if isinstance(value, np.ndarray):
            return "{" + ", ".join(map(self.number, value.ravel().tolist())) + "}"
        if isinstance(value, int):
            return str(value)
        return self.number(value)

    def array(self, name: str, values: Array) -> str:
        """Return a constant array of bytes or numbers, row by row; an empty one gets a single zero."""
        numbers = values.ravel().tolist() or [0]
        if values.dtype in _INTEGER_TYPES:
            kind = _INTEGER_TYPES[values.dtype]
            entries = map(str, numbers)
        else:
            kind = "quadsim_real"
            entries = map(self.number, numbers)
        lines = textwrap.wrap(", ".join(entries), 116, break_on_hyphens=False)
        return self._array(kind, name, values.size, lines)

    def initialisers(self, members: Mapping[str, float | Array]) -> dict[str, str]:
        """Return the initialisers of a struct's members, each as of `value`."""
        return {name: self.value(value) for name, value in members.items()}

    def struct(self, kind: str, name: str, **members: str) -> str:
        """A constant struct, by names of members."""
        wrap = textwrap.TextWrapper(120, initial_indent="    ", subsequent_indent="        ")
        lines = [wrap.fill(f".{member} = {value},") for member, value in members.items()]
        return "\n".join([f"static const {kind} {name} = {{", *lines, "};\n"])

    def mirrored(self, struct: Struct, pointers: Mapping[str, str] | None = None, **others: int) -> dict[str, str]:
        """Return the initialisers of a struct that Python mirrors.

        Args:
            struct: it; an infinite number becomes +-1e30.
            pointers: initialisers of its pointers; NULL of those left out.
            others: values of members that replace those of the struct.
        """
        addresses = pointers or {}
        initialisers = {}
        for name, kind, *_ in struct._fields_:
            if kind is ctypes.c_void_p:
                initialisers[name] = addresses.get(name, "NULL")
                continue
            value = others.get(name, getattr(struct, name))
            if isinstance(value, float):
                value = min(max(value, -NO_BOUND), NO_BOUND)
            elif isinstance(value, ctypes.Array):
                value = np.clip(np.array(value, float), -NO_BOUND, NO_BOUND)
            initialisers[name] = self.value(value)
        return initialisers

    def structs(self, kind: str, name: str, structs: Iterable[Struct]) -> str:
        """Return a constant array of structs without pointers, that Python mirrors."""
        lines = []
        for struct in structs:
            members = ", ".join(self.mirrored(struct).values())
            lines.append(f"{{{members}}},")
        return self._array(kind, name, len(lines), lines or ["{0}"])

    def members(self, values: Mapping[str, Any], suffix: str = "") -> tuple[list[str], dict[str, str]]:
        """Return the arrays that a struct's members point to, with names ending in `suffix`, and its initialisers."""
        blocks = list[str]()
        initialisers = dict[str, str]()
        for name, value in values.items():
            if isinstance(value, list):
                blocks += self._entries(name, value)
                initialisers[name] = f"{self.prefix}{name}{suffix}"
            elif isinstance(value, np.ndarray):
                blocks.append(self.array(f"{name}{suffix}", value))
                initialisers[name] = f"{self.prefix}{name}{suffix}"
            else:
                initialisers[name] = self.value(value)
        return blocks, initialisers

    def _entries(self, name: str, entries: Sequence[Mapping[str, Any]]) -> list[str]:
        """Return a constant array of structs, after the arrays that these point to."""
        blocks = list[str]()
        lines = []
        for i, entry in enumerate(entries):
            arrays, initialisers = self.members(entry, f"_{i}")
            blocks += arrays
            members = ", ".join(f".{member} = {value}" for member, value in initialisers.items())
            lines.append(f"{{{members}}}")
        text = ",\n".join(lines or ["{0}"])
        blocks.append(self._array(ENTRIES[name].__name__, name, len(entries), text.splitlines()))
        return blocks

    def _array(self, kind: str, name: str, size: int, lines: Iterable[str]) -> str:
        """Return a constant array of a C type, given the lines of its initialiser."""
        body = "\n".join(f"    {line}" for line in lines)
        return f"static const {kind} {self.prefix}{name}[{max(size, 1)}] = {{\n{body}\n}};\n"
