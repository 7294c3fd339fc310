"""An MPC for vehicles as they are: disturbances, rotors that lag, delays, soft and tightened bounds."""
