"""Ceilings: methods that know part of the truth, and say so."""
