"""Oracles: diagnosers that are told a part of the truth. Each says which, and whether that makes it a ceiling."""
