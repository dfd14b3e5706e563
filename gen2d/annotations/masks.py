"""Instance masks: the object that each pixel shows most of."""

from gen2d.plugin import Annotation, Array, Field, FramePlan, RenderScene, option


def annotate(scenes: RenderScene, owners: Array, plan: FramePlan, on: bool) -> dict[str, Array]:
    """Instance masks, which are the owners."""
    return {"masks/instance": owners}


ANNOTATION = Annotation(
    options=option(False, bool, "", "instance masks"),
    fields={
        "masks/instance": Field(
            "uint8",
            "n T H W",
            "id",
            "slot + 1 of the object that covers most of the pixel; 0: background, 255: occluder",
        )
    },
    annotate=annotate,
    owners=True,
    distorted=True,
)
