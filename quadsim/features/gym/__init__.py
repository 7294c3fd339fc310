"""Scenarios as Gymnasium environments, re-exported by `quadsim.gym`; only this folder imports gymnasium."""
