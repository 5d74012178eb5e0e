"""Measurements of the README, of models/ and of experiments/results: `python -m experiments NAME`."""
