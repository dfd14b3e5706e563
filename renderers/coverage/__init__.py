"""Pixel coverage of shapes, in closed form."""
