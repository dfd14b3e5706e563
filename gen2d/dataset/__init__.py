"""A dataset's folder: what it is to hold, its shards, its manifest, its cards. Imports no jax."""
