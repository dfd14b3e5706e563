"""Scenes built by hand: bodies and joints in a few lines of Python, simulated at once."""
