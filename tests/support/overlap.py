"""Exact overlap of convex bodies, in float64, from the stored fields alone.

A body is a convex core, whose corners are those of a polygon, the ends of a capsule or segment, or the centre of a
disc, and a radius around it. Two cores that intersect overlap by the least of their overlaps along the normals of all
edges, as these are the edges of their Minkowski difference; others are as far apart as a corner is from an edge.
"""

import jax
import numpy as np

from gen2d.core.enums import DYNAMIC
from gen2d.records.scene import Objects

LEAST = 1e-9  # m: shorter edges are points, and cores that overlap by less touch


def cores(objects: Objects, position: np.ndarray, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners [..., K, V, 2] and radii [..., K] of bodies at `position` [..., K, 2] and `angle` [..., K]."""
    half = np.asarray(objects.half_length, float)[..., None]
    ends = np.concatenate([half, -half], axis=-1)
    corners = np.stack([ends, np.zeros_like(ends)], axis=-1)
    if objects.vertices is not None:
        vertices = np.asarray(objects.vertices, float)
        pad = np.repeat(corners[..., -1:, :], max(vertices.shape[-2] - 2, 0), axis=-2)
        polygon = np.asarray(objects.vertex_count)[..., None, None] > 0
        corners = np.where(polygon, vertices, np.concatenate([corners, pad], axis=-2))
    c, s = np.cos(angle)[..., None], np.sin(angle)[..., None]
    x, y = corners[..., 0], corners[..., 1]
    turned = np.stack([c * x - s * y, s * x + c * y], axis=-1)
    return turned + position[..., None, :], np.broadcast_to(np.asarray(objects.radius, float), angle.shape)


def _along_normals(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Largest gap between two cores [..., V, 2] along an outward normal of `a`; negative if all overlap."""
    edges = np.roll(a, -1, axis=-2) - a
    length = np.linalg.norm(edges, axis=-1)
    edge = length > LEAST
    along = edges / np.where(edge, length, 1.0)[..., None]
    normal = np.stack([along[..., 1], -along[..., 0]], axis=-1)
    gaps = np.einsum("...vi,...wvi->...vw", normal, b[..., :, None, :] - a[..., None, :, :]).min(-1)
    return np.where(edge, gaps, -np.inf).max(-1)


def _corner_to_edge(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Least distance of a corner of `a` [..., V, 2] from an edge of `b`."""
    edges = (np.roll(b, -1, axis=-2) - b)[..., None, :, :]
    offset = a[..., :, None, :] - b[..., None, :, :]
    square = np.maximum((edges**2).sum(-1), LEAST**2)
    part = np.clip((offset * edges).sum(-1) / square, 0, 1)
    return np.linalg.norm(offset - part[..., None] * edges, axis=-1).min((-1, -2))


def depth_of(a: np.ndarray, b: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Overlap [...] in m of bodies with cores [..., V, 2] and this sum of radii [...]; negative if they are apart."""
    inside = np.maximum(_along_normals(a, b), _along_normals(b, a))
    apart = np.minimum(_corner_to_edge(a, b), _corner_to_edge(b, a))
    return radii - np.where((inside > -LEAST) | ~np.isfinite(inside), apart, inside)


def deepest(objects: Objects, position: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Deepest overlap [n, T] in m of a dynamic body with another body, at `position` [n, T, K, 2], `angle` [n, T, K].

    -inf where there is no pair.
    """
    expanded = jax.tree.map(lambda x: np.asarray(x)[:, None], objects)
    corners, radius = cores(expanded, np.asarray(position, float), np.asarray(angle, float))
    present, kind = np.asarray(objects.present), np.asarray(objects.kind)
    deepest = np.full(radius.shape[:2], -np.inf)
    for i in range(radius.shape[2]):
        for j in range(i):
            there = present[:, i] & present[:, j] & ((kind[:, i] == DYNAMIC) | (kind[:, j] == DYNAMIC))
            if there.any():
                depth = depth_of(corners[there, :, i], corners[there, :, j], radius[there, :, i] + radius[there, :, j])
                deepest[there] = np.maximum(deepest[there], depth)
    return deepest
