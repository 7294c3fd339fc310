"""A controller as self-contained C99: the numbers of its optimisation, and the sources that solve it."""
