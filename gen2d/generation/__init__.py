"""The host's loop: encode, write and complete a dataset, and make parts of one again."""
