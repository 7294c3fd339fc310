"""Constants as C99 text; equal numbers give equal text."""

from __future__ import annotations

import ctypes
import textwrap
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np

from quadsim.core.mirror import Struct
from quadsim.mpc.solvers.core import ENTRIES
from quadsim.mpc.solvers.core_tables import NO_BOUND
from quadsim.state import Array

Precision = Literal["double", "float"]
_KINDS: Final = {np.dtype(np.uint8): "unsigned char", np.dtype(np.intc): "int"}
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
        if values.dtype in _KINDS:
            kind = _KINDS[values.dtype]
            entries = map(str, numbers)
        else:
            kind = "quadsim_real"
            entries = map(self.number, numbers)
        lines = textwrap.wrap(", ".join(entries), 116, break_on_hyphens=False)
        return self._array(kind, name, values.size, lines)

    def values(self, values: Mapping[str, Any]) -> dict[str, str]:
        """Return initialisers of integers, numbers and arrays of these, by names of members."""
        return {name: self.value(value) for name, value in values.items()}

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
        initialisers = {}
        for name, kind, *_ in struct._fields_:
            if kind is ctypes.c_void_p:
                initialisers[name] = (pointers or {}).get(name, "NULL")
            else:
                value = others.get(name, getattr(struct, name))
                if isinstance(value, ctypes.Array):
                    value = np.clip(np.array(value, float), -NO_BOUND, NO_BOUND)
                elif isinstance(value, float):
                    value = np.clip(np.array(value, float), -NO_BOUND, NO_BOUND).item()
                initialisers[name] = self.value(value)
        return initialisers

    def structs(self, kind: str, name: str, structs: Iterable[Struct]) -> str:
        """Return a constant array of structs without pointers, that Python mirrors."""
        lines = []
        for struct in structs:
            initialisers = ", ".join(self.mirrored(struct).values())
            lines.append("{" + initialisers + "},")
        return self._array(kind, name, len(lines), lines or ["{0}"])

    def members(self, values: Mapping[str, Any], suffix: str = "") -> tuple[list[str], dict[str, str]]:
        """Return the arrays that a struct's members point to, with names ending in `suffix`, and its initialisers."""
        blocks = list[str]()
        initialisers = dict[str, str]()
        for name, value in values.items():
            initialisers[name] = f"{self.prefix}{name}{suffix}"
            if isinstance(value, list):
                entries = []
                for i, part in enumerate(value):
                    inner_blocks, inner = self.members(part, f"_{i}")
                    blocks += inner_blocks
                    entries.append("{" + ", ".join(f".{member} = {text}" for member, text in inner.items()) + "}")
                lines = ",\n".join(entries or ["{0}"]).splitlines()
                blocks.append(self._array(ENTRIES[name].__name__, name, len(value), lines))
            elif isinstance(value, np.ndarray):
                blocks.append(self.array(f"{name}{suffix}", value))
            else:
                initialisers[name] = self.value(value)
        return blocks, initialisers

    def _array(self, kind: str, name: str, size: int, lines: Iterable[str]) -> str:
        body = "\n".join(f"    {line}" for line in lines)
        return f"static const {kind} {self.prefix}{name}[{max(size, 1)}] = {{\n{body}\n}};\n"
