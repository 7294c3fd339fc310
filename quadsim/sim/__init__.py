"""What moves: the plant and its effects, sensors, state estimation, and the closed loop."""
