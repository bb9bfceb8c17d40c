"""The missile's reference figures, measured again: `python -m benchmarks.reproduction.missile_pitch [--quick]`.

The numbered episodes are the data sheet's own, so their counts must be identical; where random numbers differ, the spread
decides.
"""
