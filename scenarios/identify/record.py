"""Flight logs of any make as one record: uniform samples in quadsim's frames and units."""

from __future__ import annotations

from dataclasses import dataclass

from quadsim.state import Array


@dataclass(frozen=True, kw_only=True)
class Record:
    """A flight as it was logged: N samples, uniform in time; world z up, body x forward, y left, z up."""

    name: str  # of the log, for messages and sources
    t: Array  # (N,) [s]
    velocity: Array  # (N, 3) of the centre of mass, world [m/s]
    attitude: Array  # (N, 4) quaternion wxyz, body to world, sign continuous
    rates: Array  # (N, 3) body rates [rad/s]
    position: Array | None = None  # (N, 3) world [m]
    commands: Array | None = None  # (N, 4) rotor speeds commanded at t_k and held until t_{k+1} [rad/s]
    throttle: Array | None = None  # (N, 4) the same as a share of full throttle [-]; one of these three is there
    speeds: Array | None = None  # (N, 4) measured rotor speeds [rad/s]
    voltage: Array | None = None  # (N,) of the battery [V]

    @property
    def period(self) -> float:
        """Time between samples [s]."""
        return float(self.t[1] - self.t[0])
