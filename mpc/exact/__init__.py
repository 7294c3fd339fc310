"""Ways to the exact optimum that solve no more than has to be solved."""
