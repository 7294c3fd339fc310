"""The core: the exact optimum of problems whose matrices are fixed, in C99, compiled once and exported as it is."""
