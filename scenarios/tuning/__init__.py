"""Tuning: Optuna searches fields; the result is tested on draws that the search did not use."""
