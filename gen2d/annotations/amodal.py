"""Amodal masks: the pixels that an object covers by half or more, visible or not, as packed bits."""

import jax.numpy as jnp

from gen2d.plugin import Annotation, Array, Field, FramePlan, RenderScene, alone, each_video, option


def sizes(plan: FramePlan, on: bool) -> dict[str, int]:
    """Length B of a packed mask in bytes: `numpy.unpackbits(packed)[: H * W].reshape(H, W)` is the mask."""
    return {"B": -(-plan.height * plan.width // 8)}


def annotate(scenes: RenderScene, owners: Array | None, plan: FramePlan, on: bool) -> dict[str, Array]:
    """Packed masks of every slot."""
    pixels = plan.height * plan.width
    weights = jnp.asarray([128, 64, 32, 16, 8, 4, 2, 1], jnp.uint8)

    def packed(cover: Array) -> Array:
        bits = (cover >= 0.5).reshape(-1, pixels)
        bits = jnp.pad(bits, [(0, 0), (0, -pixels % 8)]).reshape(len(bits), -1, 8)
        return jnp.where(bits, weights, 0).astype(jnp.uint8).sum(-1, dtype=jnp.uint8)

    return {"masks/amodal": each_video(lambda scene: alone(scene, plan, packed), scenes)}


ANNOTATION = Annotation(
    options=option(False, bool, "", "masks of whole objects, hidden parts included, one bit per pixel"),
    fields={
        "masks/amodal": Field(
            "uint8",
            "n T K B",
            "1",
            "mask of pixels at least half covered, hidden parts included; row-major bits, first pixel highest",
        )
    },
    annotate=annotate,
    sizes=sizes,
)
