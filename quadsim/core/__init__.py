"""quadsim's C: one shared library of the sources here and in `quadsim/mpc/c`, compiled where it is missing or stale.

`build` compiles it and `library` loads it; `headers` reads what the C declares, `mirror` makes Python's structs and
functions of that, and `structs` names those of the physics rate.
"""
