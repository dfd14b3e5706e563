"""Bounding boxes: around the visible pixels of each object, and around the whole object."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.plugin import Annotation, Array, Field, FramePlan, RenderScene, extents, option, reduce_halves

WORD_BITS = 32  # slots per word, one bit each


def annotate(scenes: RenderScene, owners: Array, plan: FramePlan, on: bool) -> dict[str, Array]:
    """Visible and amodal boxes."""
    seen = visible_boxes(owners.reshape(-1, *owners.shape[2:]), plan.layout.slots)
    return {
        "boxes/visible": seen.reshape(*owners.shape[:2], *seen.shape[1:]),
        "boxes/amodal": jax.vmap(functools.partial(extents.bounding_boxes, plan=plan))(scenes),
    }


def visible_boxes(owners: Array, slots: int) -> Array:
    """Boxes [T, K, 4] px (x0 y0 x1 y1) around the pixels of each slot in masks [T, H, W]; 0 for slots without any."""
    boxes = []
    for first in range(0, slots, WORD_BITS):
        columns, rows = _bit_words(owners, first)
        # The loop keeps the compiler from scanning all pixels again for each slot. It runs over constants: for an iota
        # XLA's CPU compiler generates a loop that takes seven times as long.
        bits = np.arange(min(WORD_BITS, slots - first), dtype=np.uint32)
        ends = [jax.lax.map(functools.partial(_extent_of_bit, words=words.T), bits) for words in (columns, rows)]
        boxes.append(jnp.stack([ends[0][0], ends[1][0], ends[0][1], ends[1][1]], -1))
    return jnp.moveaxis(jnp.concatenate(boxes), 0, 1)


def _bit_words(owners: Array, first: int) -> tuple[Array, Array]:
    """Words of the columns [T, W] and rows [T, H] of masks [T, H, W]: bit i is set where slot first + i is visible."""
    number = owners.astype(jnp.uint32) - (first + 1)  # wraps around below
    bits = jnp.where(number < WORD_BITS, jnp.uint32(1) << (number & (WORD_BITS - 1)), jnp.uint32(0))
    return reduce_halves(bits, 1, jnp.bitwise_or), reduce_halves(bits, 2, jnp.bitwise_or)


def _extent_of_bit(bit: Array, words: Array) -> tuple[Array, Array]:
    """First index of words [L, T] with `bit` set, and the index after the last, [T] float32; both 0 if none has it."""
    present, position = (words >> bit) & 1 > 0, jnp.arange(len(words), dtype=jnp.float32)[:, None]
    last = reduce_halves(jnp.where(present, position + 1, 0.0), 0, jnp.maximum)
    first = len(words) - reduce_halves(jnp.where(present, len(words) - position, 0.0), 0, jnp.maximum)
    return jnp.minimum(first, last), last


ANNOTATION = Annotation(
    options=option(False, bool, "", "bounding boxes of the visible pixels and of the whole of each object"),
    fields={
        "boxes/visible": Field(
            "float32",
            "n T K 4",
            "px",
            "bounding box x0 y0 x1 y1 of the pixels of the instance mask; 0 where there are none",
        ),
        "boxes/amodal": Field(
            "float32", "n T K 4", "px", "subpixel bounding box x0 y0 x1 y1 of the whole object, also beyond the frame"
        ),
    },
    annotate=annotate,
    owners=True,
)
