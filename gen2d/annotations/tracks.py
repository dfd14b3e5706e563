"""Tracks of points that are fixed to objects."""

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
    SlotGroup,
    distorted_points,
    fraction,
    hashed,
    option,
    pixel_at,
    to_pixels,
)


def sizes(plan: FramePlan, count: int) -> dict[str, int]:
    """Length of the axis P: `count` points for every slot."""
    return {"P": plan.layout.slots * count}


def annotate(scenes: RenderScene, owners: Array, plan: FramePlan, count: int) -> dict[str, Array]:
    """Points, their visibility, and the slots that they are fixed to."""
    return jax.vmap(functools.partial(_tracks_of_video, plan=plan, count=count))(scenes, owners)


def _tracks_of_video(scene: RenderScene, owners: Array, plan: FramePlan, count: int) -> dict[str, Array]:
    """Tracks of `count` points of each slot of one video."""
    local = jnp.concatenate(
        [_random_points(scene, run, first, count) for run, first in plan.layout.spans]
    )  # [K, P, 2] m
    at = scene.instants
    cos, sin = jnp.cos(at.angle)[..., None], jnp.sin(at.angle)[..., None]
    x, y = local[..., 0], local[..., 1]
    world = at.position[:, :, None] + jnp.stack([x * cos - y * sin, x * sin + y * cos], -1)
    points = to_pixels(at.view, world.reshape(len(world), -1, 2), plan.height, plan.width)
    if scene.sensor is not None and scene.sensor.distortion is not None:
        points = distorted_points(points, scene.sensor.distortion, plan.height, plan.width)
    slots = np.repeat(np.arange(plan.layout.slots), count)
    drawn = scene.paint.drawn[slots]
    points = jnp.where(drawn[:, None], points, 0.0)
    pixel, inside = pixel_at(points[..., 0], points[..., 1], plan.height, plan.width)
    shown = jnp.take_along_axis(owners.reshape(len(owners), -1), pixel, axis=1)
    return {
        "tracks/points": points,
        "tracks/visible": drawn & inside & (shown == slots + 1),
        "tracks/object": jnp.where(drawn, slots, -1).astype(jnp.int16),
    }


def _random_points(scene: RenderScene, run: SlotGroup, first: int, count: int) -> Array:
    """Random points [k, P, 2] m, uniform in the area of the shapes of a run, in the body frame.

    Rounded polygons have points in their core only.
    """
    slots = jnp.arange(first, first + run.count)[:, None]
    hashes = (hashed(scene.seed, slots, jnp.arange(count), n) for n in range(1, 4))
    u, v, w = map(fraction, hashes)
    radius = scene.bodies.radius[slots]
    reach, angle = radius * jnp.sqrt(u), 2 * jnp.pi * v
    disc = jnp.stack([reach * jnp.cos(angle), reach * jnp.sin(angle)], -1)
    if run.shape == "circle":
        return disc
    if run.shape == "polygon":
        assert scene.bodies.vertices is not None
        return _points_in_polygon(scene.bodies.vertices[first : first + run.count], u, v, w)
    half = scene.bodies.half_length[slots]
    # A capsule: a point is in the rectangle or in the half discs at its ends, in proportion to their areas.
    in_block = w * (4 * half + jnp.pi * radius) < 4 * half
    block = jnp.stack([half * (2 * u - 1), radius * (2 * v - 1)], -1)
    caps = disc + jnp.stack([jnp.where(disc[..., 0] > 0, half, -half), jnp.zeros_like(reach)], -1)
    return jnp.where(in_block[..., None], block, caps)


def _points_in_polygon(vertices: Array, u: Array, v: Array, w: Array) -> Array:
    """Points [k, P, 2] uniform in polygons, which are cut into triangles at the first vertex, chosen by area."""
    corners = vertices - vertices[:, :1]
    following = jnp.roll(corners, -1, axis=1)
    area = corners[..., 0] * following[..., 1] - corners[..., 1] * following[..., 0]
    share = jnp.cumsum(area, axis=1)
    side = (w[..., None] * share[:, None, -1:] > share[:, None]).sum(-1)
    side = jnp.minimum(side, vertices.shape[1] - 1)
    first, second = (jnp.take_along_axis(a, side[..., None], axis=1) for a in (corners, following))
    depth = jnp.sqrt(u)[..., None]
    return vertices[:, :1] + depth * (first + v[..., None] * (second - first))


ANNOTATION = Annotation(
    options=option(0, int, "points", "number of tracked points per object; 0: none", low=0, high=1024),
    fields={
        "tracks/points": Field(
            "float32",
            "n T P 2",
            "px",
            "positions, x right, y down, of points fixed to objects and uniform in their area",
        ),
        "tracks/visible": Field("bool", "n T P", "1", "whether the point lies in a pixel that shows its object"),
        "tracks/object": Field("int16", "n P", "object", "slot of the object that the point is fixed to; -1: none"),
    },
    annotate=annotate,
    sizes=sizes,
    owners=True,
    distorted=True,
    usual=8,
)
