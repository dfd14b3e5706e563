"""Basics that every other package may import: errors, field descriptions, progress."""
