"""The command line: `quadsim` and the commands of the core; a room's are in its own `commands.py`."""
