"""Published figures, measured again: one folder per paper, `python -m benchmarks.reproduction.<plant>`.

A folder holds what is printed, with its sources (`reference.toml`), what differs from the paper and why
(`differences.toml`), its claims as tests (`claims.py`), what is measured, and the page. `python -m benchmarks.reproduction`
writes the index over the papers.
"""
