"""The version of gen2d."""

__version__ = "0.1.0"
