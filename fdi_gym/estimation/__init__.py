"""Atoms that several filters share: updates, two-stage algebra, tests on innovations, decision logic."""
