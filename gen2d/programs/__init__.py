"""Compiled programs of a config, which sample, simulate and render videos, and their uses without a dataset."""
