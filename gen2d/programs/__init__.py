"""Compiled programs of a config: sample, simulate, render; and what uses them without a dataset."""
