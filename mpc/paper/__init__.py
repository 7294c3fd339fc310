"""The optimisation as the paper prints it, condensed to the inputs alone.  Eqs. (2)-(29)."""
