"""The command line: `quadsim` and the commands of the core; a feature's are in its own `commands.py`."""
