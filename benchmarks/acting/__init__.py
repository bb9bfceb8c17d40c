"""Diagnoses that act: what probing and accommodation are worth. `python -m benchmarks.acting`."""
