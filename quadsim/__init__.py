"""The testbed: vehicle, plant, closed loop, log, audit, and everything written to disk."""

__version__ = "0.1.0"
