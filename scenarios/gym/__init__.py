"""Scenarios as Gymnasium environments, what `quadsim.gym` hands out; the only folder that imports gymnasium."""
