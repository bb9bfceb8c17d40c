"""The hovering helicopter's reference figures, measured again: `python -m benchmarks.reproduction.huav_hover [--quick]`."""
