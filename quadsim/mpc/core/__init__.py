"""The core: the exact optimum of problems with constant matrices, in C99, compiled once and exported as it is."""
