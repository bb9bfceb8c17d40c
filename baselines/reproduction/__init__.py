"""Published and reference figures, measured again: one module per plant, `python -m baselines.reproduction.<plant>`."""
