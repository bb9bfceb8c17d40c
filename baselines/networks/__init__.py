"""Networks and their training: what `baselines.learned` runs. Needs `pip install fdi-gym[learn]`; nothing else does."""
