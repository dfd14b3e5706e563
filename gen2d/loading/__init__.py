"""Readers of complete datasets: videos by index, shuffled batches, and several datasets as one. Imports no jax."""
