"""Instance masks: the object that each pixel shows most of."""

from gen2d.plugin import Annotation, Array, Field, FramePlan, RenderScene, option


def annotate(stages: RenderScene, owners: Array, plan: FramePlan, on: bool) -> dict[str, Array]:
    """Instance masks, which are the owners."""
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
