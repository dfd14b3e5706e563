"""The share of each pixel that a shape covers, in closed form."""
