"""Scenes sampled from distributions: slots, placement, rejection, matched sets."""
