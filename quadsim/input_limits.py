"""How much of an input is read: a file costs about a second at most, and memory as the longest flight does."""

from __future__ import annotations

from typing import Final

LARGEST_TOML: Final = 8_000_000  # [bytes]; the longest possible scenario is smaller
LARGEST_CSV: Final = 64_000_000  # [bytes]
LARGEST_JSON: Final = 64_000_000  # [bytes]
MOST_ASSIGNMENTS: Final = 150_000  # `=` of a TOML file; a scenario with as many events as allowed has half of them
MOST_ENTRIES: Final = 1000  # of a list of tables, and keys of a table
MOST_STEPS: Final = 10_000_000  # of a flight: physics steps, or control periods times their samples
MOST_ROWS: Final = MOST_STEPS + 1  # of a table of a log: one per physics step of the longest flight
MOST_COLUMNS: Final = 10_000  # of a table; a campaign has three per constraint and one per draw
LARGEST_TABLE: Final = 4_000_000_000  # numbers of a table in memory [bytes]
LARGEST_TEXTS: Final = 500_000_000  # its texts in memory [bytes]
