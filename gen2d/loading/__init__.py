"""Reading a complete dataset: videos by number, batches in order, several datasets as one. Imports no jax."""
