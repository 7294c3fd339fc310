"""A flight: its log in memory and on disk, its audit and metrics, and the run directory."""
