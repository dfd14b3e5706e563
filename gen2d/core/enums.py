"""Integer codes of stored fields, importable without jax."""

DYNAMIC, STATIC, KINEMATIC = range(3)  # objects/kind
SHAPES = ("circle", "segment", "capsule", "polygon")  # objects/shape is an index into this
CIRCLE, SEGMENT, CAPSULE, POLYGON = range(4)
JOINT_KINDS = ("distance", "revolute")  # joints/kind is an index into this
NO_CONTACT, IMPACT, BEGIN, PERSIST, END = range(5)  # contacts/kind
