"""Configs: YAML to checked options, distributions and splits."""
