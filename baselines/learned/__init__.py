"""Learned diagnosers. torch and stable-baselines3 are imported inside the builders only."""
