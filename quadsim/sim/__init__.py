"""The simulation: plant and effects, sensors, state estimation, and the closed loop."""
