"""Feedback laws to compare with MPC: LQR, cascaded PID, geometric control on SE(3)."""
