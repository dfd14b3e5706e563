"""Configs: YAML files read into checked options, distributions and splits."""
