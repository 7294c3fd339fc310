"""Feedback laws to compare an MPC with: LQR, cascaded PID, geometric control on SE(3)."""
