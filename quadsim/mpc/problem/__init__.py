"""What is optimised: models of the vehicle, constraints, the optimal control problem, and the theory around it."""
