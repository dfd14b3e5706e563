"""English captions and event lists, from stored fields."""
