"""Sampling of scenes from distributions: factors, slots, placement, rejection, matched sets."""
