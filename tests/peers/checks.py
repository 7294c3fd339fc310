"""A comparison with software that others wrote, as a value: what was measured, and what is allowed."""

from __future__ import annotations

import importlib.metadata
from dataclasses import dataclass
from typing import Final

HEAD: Final = ("check", "peer", "measured", "allowed")


@dataclass(frozen=True, kw_only=True)
class Check:
    """One figure that must not exceed what is allowed."""

    what: str  # the difference measured
    peer: str  # the distribution that it is a difference from
    measured: float  # the largest found, in `unit`
    allowed: float  # the largest that passes
    unit: str = ""  # unit of both; empty for a ratio

    @property
    def holds(self) -> bool:
        """Whether the figure is within what is allowed; NaN is not."""
        return self.measured <= self.allowed

    @property
    def row(self) -> tuple[str, str, str, str]:
        """The check under `HEAD`, with the peer's installed version."""
        unit = f" {self.unit}" if self.unit else ""
        return self.what, versioned(self.peer), f"{self.measured:.1e}{unit}", f"{self.allowed:.0e}{unit}"


def versioned(package: str) -> str:
    """A distribution with its installed version."""
    return f"{package} {importlib.metadata.version(package)}"
