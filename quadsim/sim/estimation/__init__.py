"""From samples to the state a controller is told: an error-state Kalman filter, attitude on the sphere."""
