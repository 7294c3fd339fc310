"""A comparison with software that others wrote, as a value: what was measured, and what is allowed.

A row of a page is today's when it has today's versions and, where rounding decides the digits, today's magnitudes.
"""

from __future__ import annotations

import importlib.metadata
import re
from dataclasses import dataclass
from typing import Final

HEAD: Final = ("check", "peer", "measured", "allowed")
RESIDUE: Final = re.compile(r"\d\.\de[+-]\d\d")
"""How the figures are written that rounding decides, whose digits are the processor's."""
AGREEMENT: Final = 10.0
"""Factor within which they are the same on two machines."""
ROUNDING: Final = 1e-7
"""Below this they are the same whatever they are: small."""


@dataclass(frozen=True, kw_only=True)
class Check:
    """One figure that must not exceed what is allowed.

    Attributes:
        what: the difference measured.
        peer: the distribution that it is a difference from.
        measured: the largest found, in `unit`.
        allowed: the largest that passes.
        unit: unit of both; empty for a ratio.
    """

    what: str
    peer: str
    measured: float
    allowed: float
    unit: str = ""

    @property
    def holds(self) -> bool:
        """Whether the figure is within what is allowed; NaN is not."""
        return self.measured <= self.allowed

    @property
    def row(self) -> tuple[str, str, str, str]:
        """The check under `HEAD`, with the peer's installed version."""
        unit = f" {self.unit}" if self.unit else ""
        return self.what, versioned(self.peer), f"{self.measured:.1e}{unit}", f"{self.allowed:.0e}{unit}"


def outdated(row: tuple[str, ...], page: str) -> str | None:
    """What is not today's in a page's row, or None; of residues the magnitude has to be today's, all else the same."""
    for line in page.splitlines():
        cells = tuple(cell.strip() for cell in line.strip("|").split("|"))
        if _without_residues(cells) == _without_residues(row):
            pairs = list(zip(_residues(cells), _residues(row), strict=True))
            same = all(max(pair) <= max(AGREEMENT * min(pair), ROUNDING) for pair in pairs)
            return None if same else f"it states {' | '.join(cells)}; today: {' | '.join(row)}"
    return f"it has no row like {' | '.join(row)}"


def versioned(package: str) -> str:
    """A distribution with its installed version."""
    return f"{package} {importlib.metadata.version(package)}"


def _without_residues(row: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(RESIDUE.sub("...", cell) for cell in row)


def _residues(row: tuple[str, ...]) -> list[float]:
    return [float(figure) for cell in row for figure in RESIDUE.findall(cell)]
