"""The page of a dataset: index.html, one file that shows its first videos in any browser without a network."""
