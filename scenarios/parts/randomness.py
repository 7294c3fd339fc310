"""One source of randomness per purpose, all from the scenario's seed."""

from __future__ import annotations

import zlib

import numpy as np


def generator(seed: int, purpose: str) -> np.random.Generator:
    """Random numbers for one purpose, e.g. `wind`, the same whatever else draws any."""
    return np.random.default_rng(np.random.SeedSequence([seed, zlib.crc32(purpose.encode())]))
