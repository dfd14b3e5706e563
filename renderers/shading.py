"""Coverage and colour of the parts of an object: fill, rim, mark, shade, texture."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gen2d.records.axes import Array
from gen2d.renderers.coverage import disc as disc_module
from gen2d.renderers.coverage import polygon
from gen2d.renderers.lighting import ShadedColor, as_color, lit_color
from gen2d.renderers.lit_terms import LitTerms
from gen2d.renderers.noise import textured
from gen2d.renderers.paint import Paint, Texture
from gen2d.renderers.primitives import ImagePose, ObjectParts, PixelWindow, Primitive
from gen2d.renderers.relief import Relief
from gen2d.xla import materialize


class Fills(NamedTuple):
    """Colours, shade and texture of the parts of some slots; arrays [..., 3] or [...]."""

    color: Array
    rim: Array | None
    mark: Array | None
    shade: Array | None
    texture: Texture | None
    accent: Array | None  # of highlights


def fills_of(paint: Paint, slots: slice) -> Fills:
    """Fills of some slots; arrays [k, ...]."""
    color = paint.color if paint.fill is None else paint.fill
    accent = None if paint.light is None else jnp.broadcast_to(paint.light.highlight, color.shape)
    fills = Fills(color, paint.rim_color, paint.mark_color, paint.shade, paint.texture, accent)
    return jax.tree.map(lambda a: a[slots], fills)


class EdgeTerms(NamedTuple):
    """Terms of the coverage of some slots that depend on a row or a column of their windows alone."""

    whole: Any  # disc.PixelDisc or polygon.RoundedPolygon
    inner: Any
    mark: Any
    pose: ImagePose | None  # relative to the window, if the colour varies within it
    relief: Relief | None = None  # of lit surfaces
    lit: LitTerms | None = None


def edge_terms(parts: ObjectParts, window: PixelWindow, disc: bool, varied: bool) -> EdgeTerms:
    """Edge terms of parts in a window; `disc` for discs, `varied` if shade, texture or light varies the colour."""
    pose = parts.pose
    pose = pose._replace(column=pose.column - window.left, row=pose.row - window.top) if varied else None
    inner = None if parts.inner is None else _primitive_terms(parts.inner, window, disc)
    mark = None if parts.mark is None else _primitive_terms(parts.mark, window, disc=False)
    return EdgeTerms(_primitive_terms(parts.whole, window, disc), inner, mark, pose)


def _primitive_terms(primitive: Primitive, window: PixelWindow, disc: bool) -> Any:
    x, y = jnp.arange(window.columns, dtype=jnp.float32), jnp.arange(window.rows, dtype=jnp.float32)
    left, top = (jnp.asarray(edge, jnp.float32) for edge in (window.left, window.top))
    if disc:
        column, row = primitive.corners[..., 0], primitive.corners[..., 1]
        assert primitive.radius is not None
        return disc_module.disc_edge_terms(x + (left - column)[..., None], y + (top - row)[..., None], primitive.radius)
    origin = jnp.stack(jnp.broadcast_arrays(left, top), -1)
    return polygon.polygon_edge_terms(x, y, primitive.corners - origin[..., None, :], primitive.radius)


def _coverage(terms: Any, largest: float) -> Array:
    if isinstance(terms, disc_module.PixelDisc):
        return jnp.clip(disc_module.disc_coverage(terms, largest), 0.0, 1.0)
    return jnp.clip(polygon.polygon_coverage(terms), 0.0, 1.0)


def covered_color(
    edges: EdgeTerms, fills: Fills, window: PixelWindow, largest: float
) -> tuple[Array, Array | ShadedColor]:
    """Coverage [..., rows, columns] and mean colour [..., rows, columns, 3] of the covered area.

    The colour is [..., 1, 1, 3] if it does not vary. `largest` (px) bounds the radius of discs.
    """
    whole = _coverage(edges.whole, largest)
    color: Array | ShadedColor = fills.color[..., None, None, :]
    if edges.pose is not None:
        whole = whole if edges.relief is None else materialize(whole)
        color = _varied_color(color, fills, edges, edges.pose, window, whole)
    if edges.mark is None and edges.inner is None:
        return whole, color
    color = as_color(color)
    inner = whole if edges.inner is None else jnp.minimum(_coverage(edges.inner, largest), whole)
    mark = jnp.zeros_like(whole) if edges.mark is None else jnp.minimum(_coverage(edges.mark, largest), inner)
    total = (inner - mark)[..., None] * color
    if fills.mark is not None:
        total = total + mark[..., None] * fills.mark[..., None, None, :]
    if fills.rim is not None:
        total = total + (whole - inner)[..., None] * fills.rim[..., None, None, :]
    return whole, total / jnp.maximum(whole, 1e-6)[..., None]


def _varied_color(
    color: Array, fills: Fills, edges: EdgeTerms, pose: ImagePose, window: PixelWindow, cover: Array
) -> Array | ShadedColor:
    """Colours of textured, shaded or lit slots at pixel centres."""
    x = jnp.arange(window.columns) + 0.5 - pose.column[..., None]
    y = (jnp.arange(window.rows) + 0.5 - pose.row[..., None])[..., :, None]
    x = x[..., None, :]
    if fills.texture is not None:
        cos, sin, scale = (a[..., None, None] for a in (pose.cos, pose.sin, pose.scale))
        texture = fills.texture._replace(
            seed=fills.texture.seed[..., None, None],
            cell=fills.texture.cell[..., None, None],
            color=fills.texture.color[..., None, None, :],
        )
        color = textured(color, texture, (x * cos + y * sin) / scale, (y * cos - x * sin) / scale, scale)
    if fills.shade is not None:
        reach = jnp.maximum(pose.reach, 1e-3)[..., None, None]
        # Lit from the upper left: darkest at the opposite rim.
        far = ((x / reach + 0.35) ** 2 + (y / reach + 0.35) ** 2) / 2.24
        color = color * (1 - fills.shade[..., None, None] * jnp.minimum(far, 1.0))[..., None]
    if edges.relief is not None and edges.lit is not None and fills.accent is not None:
        return lit_color(color, fills.accent[..., None, None, :], edges.lit, edges.relief, pose, x, y, cover)
    return color
