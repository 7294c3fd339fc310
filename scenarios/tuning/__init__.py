"""Tuning: fields searched by Optuna, and an answer measured on draws that did not choose it."""
