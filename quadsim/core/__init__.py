"""quadsim's C: one shared library of the sources in `quadsim` and `mpc`, compiled where it is missing or stale.

What happens at the physics rate is declared in `structs`.
"""
