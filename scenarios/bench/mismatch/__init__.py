"""The model-mismatch benchmark, `quadsim bench ladder`: what each controller survives, condition by condition."""
