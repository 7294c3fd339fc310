"""What the laws are made of: the linear and the nonlinear MPC, feedback laws, attitudes, previews."""
