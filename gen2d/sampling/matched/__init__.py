"""Matched sets: videos that share a scene and differ in one thing."""
