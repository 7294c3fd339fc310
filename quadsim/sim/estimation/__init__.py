"""From samples to the state that a controller receives: an error-state Kalman filter, attitude on the sphere."""
