"""The rigid body at any attitude, and its exact derivatives."""
