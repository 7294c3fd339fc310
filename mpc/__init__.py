"""The controllers: model predictive control in numpy, scipy and PIQP, usable without a simulator."""
