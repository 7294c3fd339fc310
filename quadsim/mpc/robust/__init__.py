"""An MPC for imperfect vehicles: disturbances, rotor lag, delays, soft and tightened bounds."""
