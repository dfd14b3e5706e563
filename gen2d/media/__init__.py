"""Image and film files, independent of simulation."""
