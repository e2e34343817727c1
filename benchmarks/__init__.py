"""Measured figures: each module is run by `python -m` and writes its tables to results/."""
