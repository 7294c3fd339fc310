"""Estimates of what the model omits: disturbances from the measured motion."""
