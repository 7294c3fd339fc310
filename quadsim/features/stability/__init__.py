"""Margins of the closed loop, measured in it: up to which heading, delay, lag, mass, ... it is stable."""
