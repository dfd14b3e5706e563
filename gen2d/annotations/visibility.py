"""Visibility: number of visible pixels, and visible fraction, of each object."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.plugin import (
    Annotation,
    Array,
    Field,
    FramePlan,
    RenderScene,
    are_moving,
    each_video,
    extents,
    option,
    reduce_halves,
)


def annotate(scenes: RenderScene, owners: Array, plan: FramePlan, on: bool) -> dict[str, Array]:
    """Visible pixels and fraction of each slot, and the least fraction over moving slots and frames."""
    pixels = each_video(functools.partial(pixel_counts, slots=plan.layout.slots), owners)
    area = jax.vmap(functools.partial(extents.areas, plan=plan))(scenes)
    fraction = jnp.minimum(pixels / jnp.where(area > 0, area, 1.0), 1.0)
    return {
        "visibility/pixels": pixels,
        "visibility/fraction": jnp.where(area > 0, fraction, 0.0),
        "quality/min_visibility": jnp.where((area > 0) & are_moving(plan.layout), fraction, 1.0).min((1, 2)),
    }


def pixel_counts(owners: Array, slots: int) -> Array:
    """Numbers of pixels [T, K] int32 that show each slot in masks [T, H, W]."""
    frames, height, width = owners.shape
    rows = next(n for n in range(min(height, 255), 0, -1) if height % n == 0)  # their sum fits a byte
    strips = owners.reshape(frames, height // rows, rows, width)

    def count(owner: Array) -> Array:
        columns = reduce_halves((strips == owner).astype(jnp.uint8), 2, jnp.add).astype(jnp.int32)
        return reduce_halves(columns, 2, jnp.add).sum(1)

    return jax.lax.map(count, np.arange(1, slots + 1, dtype=np.uint8)).T


ANNOTATION = Annotation(
    options=option(False, bool, "", "visible pixels and visible fraction of each object"),
    fields={
        "visibility/pixels": Field("int32", "n T K", "px", "number of pixels of the instance mask"),
        "visibility/fraction": Field(
            "float32", "n T K", "1", "visible pixels over the area of the whole object, at most 1"
        ),
        "quality/min_visibility": Field(
            "float32", "n", "1", "smallest visibility/fraction of the moving objects over all frames"
        ),
    },
    annotate=annotate,
    owners=True,
)
