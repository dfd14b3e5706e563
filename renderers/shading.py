"""Coverage and colour of the parts of an object: fill, rim, mark, shade, texture."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gen2d.records.axes import Array
from gen2d.renderers.coverage import disc as disc_module
from gen2d.renderers.coverage import polygon
from gen2d.renderers.noise import textured
from gen2d.renderers.paint import Paint, Texture
from gen2d.renderers.primitives import BodyTransform, ObjectParts, PixelWindow, Primitive


class Fills(NamedTuple):
    """Colours, shade and texture of the parts of some slots; arrays [..., 3] or [...]."""

    color: Array
    rim: Array | None
    mark: Array | None
    shade: Array | None
    texture: Texture | None


def fills_of(paint: Paint, slots: slice) -> Fills:
    """Fills of some slots; arrays [k, ...]."""
    color = paint.color if paint.fill is None else paint.fill
    fills = Fills(color, paint.rim_color, paint.mark_color, paint.shade, paint.texture)
    return jax.tree.map(lambda a: a[slots], fills)


class EdgeSamples(NamedTuple):
    """Terms of the coverage of some slots that depend on a row or a column of their windows alone."""

    whole: Any  # disc.PixelDisc or polygon.RoundedPolygon
    inner: Any
    mark: Any
    turn: BodyTransform | None  # relative to the window, if the colour varies within it


def edge_samples(parts: ObjectParts, window: PixelWindow, disc: bool, toned: bool) -> EdgeSamples:
    """Edge samples of parts in a window; `disc` for discs, `toned` if shade or texture varies the colour."""
    turn = parts.turn
    turn = turn._replace(column=turn.column - window.left, row=turn.row - window.top) if toned else None
    inner = None if parts.inner is None else _cuts_of(parts.inner, window, disc)
    mark = None if parts.mark is None else _cuts_of(parts.mark, window, disc=False)
    return EdgeSamples(_cuts_of(parts.whole, window, disc), inner, mark, turn)


def _cuts_of(figure: Primitive, window: PixelWindow, disc: bool) -> Any:
    x, y = jnp.arange(window.columns, dtype=jnp.float32), jnp.arange(window.rows, dtype=jnp.float32)
    left, top = (jnp.asarray(edge, jnp.float32) for edge in (window.left, window.top))
    if disc:
        column, row = figure.corners[..., 0], figure.corners[..., 1]
        assert figure.radius is not None
        return disc_module.disc_cuts(x + (left - column)[..., None], y + (top - row)[..., None], figure.radius)
    origin = jnp.stack(jnp.broadcast_arrays(left, top), -1)
    return polygon.rounded_cuts(x, y, figure.corners - origin[..., None, :], figure.radius)


def _area_of(cuts: Any, largest: float) -> Array:
    if isinstance(cuts, disc_module.PixelDisc):
        return jnp.clip(disc_module.disc_area(cuts, largest), 0.0, 1.0)
    return jnp.clip(polygon.rounded_area(cuts), 0.0, 1.0)


def covered_color(cut: EdgeSamples, inks: Fills, window: PixelWindow, largest: float) -> tuple[Array, Array]:
    """Coverage [..., rows, columns] and mean colour [..., rows, columns, 3] of the covered area.

    The colour is [..., 1, 1, 3] if it does not vary. `largest` (px) bounds the radius of discs.
    """
    whole = _area_of(cut.whole, largest)
    color = inks.color[..., None, None, :]
    if cut.turn is not None:
        color = _toned(color, inks, cut.turn, window)
    if cut.mark is None and cut.inner is None:
        return whole, color
    inner = whole if cut.inner is None else jnp.minimum(_area_of(cut.inner, largest), whole)
    mark = jnp.zeros_like(whole) if cut.mark is None else jnp.minimum(_area_of(cut.mark, largest), inner)
    total = (inner - mark)[..., None] * color
    if inks.mark is not None:
        total = total + mark[..., None] * inks.mark[..., None, None, :]
    if inks.rim is not None:
        total = total + (whole - inner)[..., None] * inks.rim[..., None, None, :]
    return whole, total / jnp.maximum(whole, 1e-6)[..., None]


def _toned(color: Array, inks: Fills, turn: BodyTransform, window: PixelWindow) -> Array:
    """Colours of textured or shaded slots at pixel centres."""
    x = jnp.arange(window.columns) + 0.5 - turn.column[..., None]
    y = (jnp.arange(window.rows) + 0.5 - turn.row[..., None])[..., :, None]
    x = x[..., None, :]
    if inks.texture is not None:
        cos, sin, scale = (a[..., None, None] for a in (turn.cos, turn.sin, turn.scale))
        texture = inks.texture._replace(
            seed=inks.texture.seed[..., None, None],
            cell=inks.texture.cell[..., None, None],
            color=inks.texture.color[..., None, None, :],
        )
        color = textured(color, texture, (x * cos + y * sin) / scale, (y * cos - x * sin) / scale)
    if inks.shade is not None:
        reach = jnp.maximum(turn.reach, 1e-3)[..., None, None]
        # Lit from the upper left: darkest at the opposite rim.
        far = ((x / reach + 0.35) ** 2 + (y / reach + 0.35) ** 2) / 2.24
        color = color * (1 - inks.shade[..., None, None] * jnp.minimum(far, 1.0))[..., None]
    return color
