"""Codes of what stands in stored fields."""

DYNAMIC, STATIC, KINEMATIC = 0, 1, 2  # objects/kind
SHAPES = ("circle", "segment", "capsule", "polygon")  # objects/shape is an index into this
