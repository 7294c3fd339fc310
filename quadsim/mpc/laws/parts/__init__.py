"""What the controllers are made of: the linear and the nonlinear MPC, baselines, attitudes, previews."""
