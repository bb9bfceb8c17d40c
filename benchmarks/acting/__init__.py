"""Diagnoses that act: who enters which suite, and what could be known. `python -m benchmarks.acting`."""
