"""World to pixels: what each slot is drawn as becomes uint8 frames, back to front, on the device.

Pixels are (row, column) from the top left, pixel centres at (j + 0.5); the world is in metres, y up. A pixel takes an
object's colour in proportion to its coverage, estimated from the signed distance d (in pixels) of the pixel's centre
to the object's rim: clip(1/2 - d, 0, 1), with the radius of a disc so that its area is kept. Blending is done on sRGB
values, as most tools do.

What never moves is drawn once a video. Moving discs are drawn in one of two forms that give the same image: on a CPU
each disc touches a patch of its own size, in one flat loop over frames and discs (under `vmap` the loop would become a
scatter, half as fast); on a GPU every pixel looks at every disc, which fuses into one kernel.
"""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.types import Array, Layout, Scene, State

LANES = 8  # pixels: a patch's rows are whole SIMD vectors
ABSENT = -1e6  # px: the radius of what is not drawn


class Paint(NamedTuple):
    """What a look gives for one video: sRGB values 0 to 255 as floats."""

    background: Array  # [3]
    color: Array  # [K, 3]
    line: Array  # [segments] px: half the width of a segment's line beyond its own radius, -inf where it is not drawn


@dataclasses.dataclass(frozen=True)
class View:
    """The camera: the one place where metres become pixels."""

    height: int  # px
    width: int  # px
    center: tuple[float, float]  # m, world point in the middle of the frame
    scale: float  # px/m

    def column(self, x: Any) -> Any:
        """Pixels from the left edge, of a world x."""
        return (x - self.center[0]) * self.scale + self.width / 2

    def row(self, y: Any) -> Any:
        """Pixels from the top edge, of a world y."""
        return self.height / 2 - (y - self.center[1]) * self.scale


def fitted(bounds: tuple[float, float, float, float], height: int, width: int, margin: float) -> View:
    """The view that shows all of `bounds` (left, bottom, right, top) with a margin around it, in metres."""
    left, bottom, right, top = bounds
    scale = min(width / (right - left + 2 * margin), height / (top - bottom + 2 * margin))
    return View(height, width, ((left + right) / 2, (bottom + top) / 2), scale)


def _blended(under: Array, coverage: Array, color: Array) -> Array:
    """The uint8 image after one more layer, each layer rounded, as in a frame buffer."""
    under = under.astype(jnp.float32)
    return (under + coverage * (color - under) + 0.5).astype(jnp.uint8)


def backdrop(scene: Scene, state: State, paint: Paint, layout: Layout, view: View) -> Array:
    """One video's unmoving layer, [H, W, 3] uint8: background, then the fixed segments in slot order."""
    image = jnp.broadcast_to(paint.background, (view.height, view.width, 3)).astype(jnp.uint8)
    x, y = jnp.arange(view.width) + 0.5, (jnp.arange(view.height) + 0.5)[:, None]
    for i, k in enumerate(range(layout.discs, layout.slots)):
        cos, sin = jnp.cos(state.angle[k]), jnp.sin(state.angle[k])
        dx, dy = x - view.column(state.position[k, 0]), view.row(state.position[k, 1]) - y
        half = scene.objects.half_length[k] * view.scale
        along = jnp.clip(dx * cos + dy * sin, -half, half)
        aside = jnp.square(dx - along * cos) + jnp.square(dy - along * sin)
        distance = jnp.sqrt(aside) - scene.objects.radius[k] * view.scale - paint.line[i]
        image = _blended(image, jnp.clip(0.5 - distance, 0, 1)[..., None], paint.color[k])
    return image


def ramped(radius: Array) -> Array:
    """The radius whose disc, drawn with a rim one pixel wide, has the area of `radius`: the rim adds pi / 12 px^2."""
    return jnp.where(radius > 0, jnp.sqrt(jnp.maximum(radius**2 - 1 / 12, 0.0)), radius)


class Moving(NamedTuple):
    """The moving discs of some videos in pixels, back to front."""

    column: Array  # [n, T, discs]
    row: Array  # [n, T, discs]
    radius: Array  # [n, discs], ABSENT where there is none
    color: Array  # [n, discs, 3]


def moving(scene: Scene, states: State, colors: Array, layout: Layout, view: View) -> Moving:
    """The discs in pixels; records in the stored layout, videos first."""
    discs = slice(0, layout.discs)
    radius = jnp.where(scene.objects.present, scene.objects.radius * view.scale, ABSENT)[:, discs]
    position = states.position[:, :, discs]
    return Moving(view.column(position[..., 0]), view.row(position[..., 1]), radius, colors[:, discs])


def draw_dense(backdrops: Array, discs: Moving) -> Array:
    """Frames [n, T, H, W, 3] uint8: every pixel looks at every disc. The form for GPUs."""
    videos, frames, count = discs.column.shape
    height, width = backdrops.shape[1:3]
    radius = ramped(discs.radius)
    x, y = jnp.arange(width) + 0.5, (jnp.arange(height) + 0.5)[:, None]
    image = jnp.broadcast_to(backdrops[:, None], (videos, frames, height, width, 3))
    for k in range(count):
        dx, dy = x - discs.column[:, :, k, None, None], y - discs.row[:, :, k, None, None]
        distance = jnp.sqrt(dx * dx + dy * dy) - radius[:, None, k, None, None]
        coverage = jnp.clip(0.5 - distance, 0, 1)[..., None]
        image = _blended(image, coverage, discs.color[:, None, k, None, None])
    return image


def draw_patches(backdrops: Array, discs: Moving, reach: float) -> Array:
    """The same frames, each disc drawn into a patch that holds `reach` px around any centre. The form for CPUs."""
    videos, frames, count = discs.column.shape
    height, width = backdrops.shape[1:3]
    side = math.floor(2 * reach + 1) + 1  # pixel centres at most reach + 1/2 away
    rows, columns = min(side, height), min(-(-side // LANES) * LANES, width)
    x = np.repeat(np.arange(columns, dtype=np.float32) + 0.5, 3)  # pixels lie as rows of red, green, blue, red ...
    y = np.arange(rows, dtype=np.float32)[:, None] + 0.5
    column, row, radius = discs.column.reshape(-1), discs.row.reshape(-1), ramped(discs.radius).reshape(-1)
    colors = jnp.tile(discs.color.reshape(-1, 3), (1, columns))  # ready to be read as a row of a patch

    def draw(i: Array, buffer: Array) -> Array:
        frame = i // count
        disc = frame // frames * count + i % count
        top = jnp.clip(jnp.ceil(row[i] - reach - 1).astype(jnp.int32), 0, height - rows)
        left = jnp.clip(jnp.ceil(column[i] - reach - 1).astype(jnp.int32), 0, width - columns)
        dx, dy = x + (left - column[i]), y + (top - row[i])
        distance = jnp.sqrt(dx * dx + dy * dy) - radius[disc]
        place = frame * height + top, left * 3
        under = jax.lax.dynamic_slice(buffer, place, (rows, columns * 3))
        patch = _blended(under, jnp.clip(0.5 - distance, 0, 1), colors[disc])
        return jax.lax.dynamic_update_slice(buffer, patch, place)

    buffer = backdrops.reshape(videos, 1, height, width * 3)
    buffer = jnp.broadcast_to(buffer, (videos, frames, height, width * 3)).reshape(-1, width * 3)
    buffer = jax.lax.fori_loop(0, videos * frames * count, draw, buffer)
    return buffer.reshape(videos, frames, height, width, 3)


def draw(backdrops: Array, discs: Moving, reach: float) -> Array:
    """Frames [n, T, H, W, 3] uint8 from unmoving layers [n, H, W, 3] and discs no larger than `reach` px."""
    if jax.default_backend() == "cpu":
        return draw_patches(backdrops, discs, reach)
    return draw_dense(backdrops, discs)
