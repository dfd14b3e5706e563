"""Which object each pixel shows: the one of which most is seen in it."""

from gen2d.plugin import Annotation, Array, Field, FramePlan, RenderScene, option


def annotate(stages: RenderScene, owners: Array, plan: FramePlan, on: bool) -> dict[str, Array]:
    """The mask itself."""
    return {"masks/instance": owners}


ANNOTATION = Annotation(
    options=option(False, bool, "", "which object each pixel shows"),
    fields={
        "masks/instance": Field(
            "uint8", "n T H W", "id", "slot + 1 of the object seen most of, 0 background, 255 an occluder"
        )
    },
    annotate=annotate,
    owners=True,
)
