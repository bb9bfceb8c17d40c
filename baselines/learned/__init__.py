"""Diagnosers whose numbers were learned: a file per method, and what methods and their training share.

Nothing here needs more than NumPy to be found, and safetensors to run. What imports torch or stable-baselines3 has a name
that begins with "_" and is imported when something is trained.
"""
