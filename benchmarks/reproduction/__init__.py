"""Published and reference figures, measured again: one folder per plant, `python -m benchmarks.reproduction.<plant>`.

A folder holds the printed figures with their sources (`reference.toml`), what is measured, and the page.
"""
