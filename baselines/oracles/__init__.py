"""Ceilings: diagnosers that are told a part of the truth. Each says which."""
