"""The satellite's reference figures, measured again: `python -m benchmarks.reproduction.cmg_satellite [--quick]`.

The campaign comes first: 300 episodes for each filter that the source compares and each noise level.
"""
