"""`quadsim bench`: QP solvers, flights and films measured on this machine."""
