"""Which object each pixel shows: the one of which most is seen in it."""

from gen2d.plugin import Array, Field, FramePlan, RenderScene

OWNERS = True
FIELDS = {
    "masks/instance": Field(
        "uint8", "n T H W", "id", "slot + 1 of the object seen most of, 0 background, 255 an occluder"
    )
}


def annotate(stages: RenderScene, owners: Array, plan: FramePlan, options: object) -> dict[str, Array]:
    """The mask itself."""
    return {"masks/instance": owners}
