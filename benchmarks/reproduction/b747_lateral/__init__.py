"""The Boeing 747's reference figures, measured again: `python -m benchmarks.reproduction.b747_lateral [--quick]`."""
