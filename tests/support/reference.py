"""Reference for frames and annotations: NumPy in float64, written from the definitions of the stored fields alone.

It imports nothing of gen2d and shares no method with it. The definitions are those of docs/frames.md and of the
fields (`meaning` in a dataset's manifest). A video is a mapping from stored names to the arrays of one video, without
the axis n. What a dataset does not store, the colour of the background and the line width of segments, is passed as a
`View`, and so are the occluders.

Outlines are polygons whose sides are at most 1e-5 px from the true outline, so coverages are accurate to about 2e-5.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

CIRCLE, SEGMENT, CAPSULE, POLYGON = range(4)  # objects/shape
OCCLUDER = 255  # id of occluders in masks
SAGITTA = 1e-5  # px, largest distance between an arc and its chord

Array = np.ndarray
Video = Mapping[str, Array]


class Occluder(NamedTuple):
    """A rectangle that is fixed in the frame, in front of all objects whose `objects/depth` is below `behind`."""

    box: Array  # x0 y0 x1 y1, px
    color: Array
    behind: int


class View(NamedTuple):
    """How a video is rendered, beyond its stored fields."""

    height: int
    width: int
    background: Sequence[float] = (20, 20, 20)
    wall_width: float = 1.5  # px, in addition to a segment's radius
    linear: bool = False  # whether linear light is mixed, not sRGB values
    occluders: Sequence[Occluder] = ()
    line: float = 0.0  # px, width of a line along the inside of the rim of discs and capsules; 0: none
    fill: float = 1.0  # share of the object's colour in what the line surrounds; the rest is the background's


class Outline(NamedTuple):
    """Points within `radius` of a convex polygon, in px: x right, y down."""

    core: Array  # V 2
    radius: float


class Layer(NamedTuple):
    """What one object or occluder covers in one frame."""

    id: int
    coverage: Array  # H W
    color: Array  # 3, or H W 3: the mean colour of what it covers of each pixel
    radius: float  # px


def double(values: Any) -> Array:
    """Values in float64."""
    return np.asarray(values, np.float64)


# ---- Geometry


def rotate(points: Array, angle: float | Array) -> Array:
    """Points [..., 2] rotated counter-clockwise where y is up."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([cos * points[..., 0] - sin * points[..., 1], sin * points[..., 0] + cos * points[..., 1]], -1)


def to_pixels(video: Video, t: int, points: Array, view: View) -> Array:
    """Pixel positions [..., 2] (x right, y down) of world points [..., 2] in frame t."""
    center, scale, angle = (double(video[f"camera/{name}"][t]) for name in ("center", "scale", "angle"))
    x, y = np.moveaxis(scale * rotate(points - center, -angle), -1, 0)
    return np.stack([view.width / 2 + x, view.height / 2 - y], -1)


def to_world(video: Video, t: int, pixels: Array, view: View) -> Array:
    """World points of pixel positions, the inverse of `to_pixels`."""
    center, scale, angle = (double(video[f"camera/{name}"][t]) for name in ("center", "scale", "angle"))
    up = np.stack([pixels[..., 0] - view.width / 2, view.height / 2 - pixels[..., 1]], -1)
    return center + rotate(up / scale, angle)


def from_body(video: Video, t: int, slot: int, points: Array) -> Array:
    """World points of points that are fixed to an object."""
    position, angle = (double(video[f"states/{name}"][t, slot]) for name in ("position", "angle"))
    return position + rotate(points, angle)


def to_body(video: Video, t: int, slot: int, points: Array) -> Array:
    """Points in an object's frame, the inverse of `from_body`."""
    position, angle = (double(video[f"states/{name}"][t, slot]) for name in ("position", "angle"))
    return rotate(points - position, -angle)


def body_core(video: Video, slot: int) -> Array:
    """Corners [V, 2] in m of an object's core, in the object's frame: its points within the radius form the shape."""
    if video["objects/shape"][slot] == POLYGON:
        return double(video["objects/vertices"][slot, : video["objects/vertex_count"][slot]])
    half = float(video["objects/half_length"][slot])
    return np.array([[-half, 0.0], [half, 0.0]]) if half else np.zeros((1, 2))


def rendered(video: Video, slot: int, view: View) -> bool:
    """Whether a slot holds an object that is rendered: a segment without radius is not, if lines have no width."""
    line = view.wall_width if video["objects/shape"][slot] == SEGMENT else 1.0
    return bool(video["objects/present"][slot]) and bool(video["objects/radius"][slot] or line)


def outline(video: Video, t: int, slot: int, view: View) -> Outline:
    """Outline of an object in frame t."""
    core = to_pixels(video, t, from_body(video, t, slot, body_core(video, slot)), view)
    radius = float(video["objects/radius"][slot]) * float(video["camera/scale"][t])
    return Outline(core, radius + (view.wall_width / 2 if video["objects/shape"][slot] == SEGMENT else 0.0))


def area(shape: Outline) -> float:
    """Area of a shape, px^2 (Steiner's formula)."""
    following = np.roll(shape.core, -1, axis=0)
    x, y = shape.core.T
    inside = abs((x * following[:, 1] - y * following[:, 0]).sum()) / 2
    around = np.linalg.norm(following - shape.core, axis=-1).sum()
    return inside + around * shape.radius + math.pi * shape.radius**2


def box(shape: Outline) -> Array:
    """Bounding box x0 y0 x1 y1 of a shape, px."""
    return np.concatenate([shape.core.min(0) - shape.radius, shape.core.max(0) + shape.radius])


def distance(core: Array, points: Array) -> Array:
    """Distance [N] of points [N, 2] from a convex polygon; 0 inside."""
    along = np.roll(core, -1, axis=0) - core
    from_corner = points[:, None] - core
    squares = np.maximum((along**2).sum(-1), 1e-300)
    nearest = np.clip((from_corner * along).sum(-1) / squares, 0, 1)[..., None] * along
    left = along[:, 0] * from_corner[..., 1] - along[:, 1] * from_corner[..., 0]
    inside = (len(core) > 2) & ((left >= 0).all(-1) | (left <= 0).all(-1))
    return np.where(inside, 0.0, np.linalg.norm(from_corner - nearest, axis=-1).min(-1))


# ---- Coverage


def boundary(shape: Outline) -> Array:
    """Corners [N, 2] of a polygon around the shape: for each of many directions, the point that lies farthest out."""
    sides = np.roll(shape.core, -1, axis=0) - shape.core
    normal = np.arctan2(-sides[:, 0], sides[:, 1])
    count = math.ceil(2 * math.pi / math.sqrt(8 * SAGITTA / max(shape.radius, 1e-3))) if shape.radius else 0
    corners = [normal + turn for turn in (-1e-9, 1e-9, math.pi - 1e-9, math.pi + 1e-9)]
    angle = np.sort(np.mod(np.concatenate([*corners, np.arange(count) * (2 * math.pi / max(count, 1))]), 2 * math.pi))
    direction = np.stack([np.cos(angle), np.sin(angle)], -1)
    farthest = shape.core[np.argmax(direction @ shape.core.T, axis=1)]
    between = 2 * math.pi / max(count, 1)
    grown = shape.radius * math.sqrt(between / math.sin(between)) if count else 0.0  # the polygon has the disc's area
    return farthest + grown * direction


def cut(begin: Array, end: Array, axis: int, last: int) -> tuple[Array, Array]:
    """Sides [N, 2], cut wherever they cross an integer from 0 to `last` along an axis."""
    low, high = np.minimum(begin, end)[:, axis], np.maximum(begin, end)[:, axis]
    first = np.clip(np.floor(low) + 1, 0, last + 1)
    crossings = np.maximum(np.clip(np.ceil(high) - 1, -1, last) - first + 1, 0).astype(int)
    pieces = crossings + 1
    side = np.repeat(np.arange(len(begin)), pieces)
    number = np.arange(len(side)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    a, b, along = begin[side], end[side], (end - begin)[side]
    rising = along[:, axis] > 0

    def at(crossing: Array) -> Array:
        line = first[side] + np.where(rising, crossing, crossings[side] - 1 - crossing)
        with np.errstate(divide="ignore", invalid="ignore"):
            return a + along * ((line - a[:, axis]) / along[:, axis])[:, None]

    inner_begin, inner_end = (number > 0)[:, None], (number < crossings[side])[:, None]
    return np.where(inner_begin, at(number - 1), a), np.where(inner_end, at(number), b)


def polygon_coverage(corners: Array, height: int, width: int) -> Array:
    """Covered area of each pixel [H, W]: each side adds the area between it and the right edge of the frame."""
    begin, end = corners, np.roll(corners, -1, axis=0)
    for axis, last in ((1, height), (0, width)):
        begin, end = cut(begin, end, axis, last)
    rise, middle = end[:, 1] - begin[:, 1], (begin + end) / 2
    column, row = np.floor(middle).astype(int).T
    kept = (row >= 0) & (row < height) & (column < width) & (rise != 0)
    rise, middle, row, column = rise[kept], middle[kept, 0], row[kept], column[kept]
    areas = np.zeros((2, height, width + 1))  # within the pixel of each side; in every pixel to the right of it
    inside = column >= 0
    np.add.at(areas[0], (row[inside], column[inside]), (rise * (column + 1 - middle))[inside])
    np.add.at(areas[1], (row, np.maximum(column + 1, 0)), rise)
    return np.abs(areas[0] + np.cumsum(areas[1], axis=1))[:, :width]


def coverage(shape: Outline, height: int, width: int) -> Array:
    """Share [H, W] of each pixel's area that a shape covers."""
    x0, y0, x1, y1 = box(shape)
    if x1 <= 0 or y1 <= 0 or x0 >= width or y0 >= height:
        return np.zeros((height, width))
    return polygon_coverage(boundary(shape), height, width)


# ---- Frames and owners


def outlined(shape: Outline, covered: Array, color: Array, view: View) -> Array:
    """Mean colour [H, W, 3] of what a shape covers of each pixel, with a line along the inside of its rim."""
    assert len(shape.core) <= 2, "only of discs and capsules"
    inner = Outline(shape.core, max(shape.radius - view.line, 0.0))
    share = coverage(inner, view.height, view.width) / np.maximum(covered, 1e-12) if inner.radius else 0 * covered
    fill = double(view.background) + view.fill * (color - double(view.background))
    return color + np.minimum(share, 1.0)[..., None] * (fill - color)


def layers(video: Video, t: int, view: View) -> list[Layer]:
    """Everything that frame t shows but its background, from back to front."""
    found, occluders = [], sorted(view.occluders, key=lambda occluder: occluder.behind)

    def add_occluders(rank: int) -> None:
        while occluders and occluders[0].behind <= rank:
            (x0, y0, x1, y1), color, _ = occluders.pop(0)
            corners = Outline(np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], float), 0.0)
            found.append(Layer(OCCLUDER, coverage(corners, view.height, view.width), double(color), 0.0))

    slots = [slot for slot in range(len(video["objects/depth"])) if rendered(video, slot, view)]
    for slot in sorted(slots, key=lambda slot: int(video["objects/depth"][slot])):
        add_occluders(int(video["objects/depth"][slot]))
        shape = outline(video, t, slot, view)
        covered = coverage(shape, view.height, view.width)
        color = double(video["objects/color"][slot])
        if view.line and video["objects/shape"][slot] != SEGMENT:
            color = outlined(shape, covered, color, view)
        found.append(Layer(slot + 1, covered, color, shape.radius))
    add_occluders(len(video["objects/depth"]))
    return found


def to_light(values: Array) -> Array:
    """Linear light, 0 to 1, of sRGB values from 0 to 255 (IEC 61966-2-1)."""
    share = np.asarray(values, float) / 255
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def from_light(light: Array) -> Array:
    """SRGB values from 0 to 255 of linear light."""
    share = np.where(light <= 0.0031308, light * 12.92, 1.055 * np.maximum(light, 0.0031308) ** (1 / 2.4) - 0.055)
    return 255 * share


def shares(found: Sequence[Layer], view: View) -> tuple[Array, Array]:
    """Ids [N + 1] of the background and all layers, and the share [N + 1, H, W] of each pixel that shows each."""
    shown = np.zeros((len(found) + 1, view.height, view.width))
    shown[0] = 1
    for number, layer in enumerate(found, 1):
        shown *= 1 - layer.coverage
        shown[number] = layer.coverage
    return np.array([0, *(layer.id for layer in found)]), shown


def mix(under: Array, color: Array, coverage: Array, linear: bool) -> Array:
    """SRGB values of a pixel of which a layer covers a share: means of sRGB values, or of linear light."""
    if not linear:
        return under + coverage * (color - under)
    return from_light(to_light(under) + coverage * (to_light(color) - to_light(under)))


def background(view: View) -> Array:
    """A frame [H, W, 3] that shows nothing."""
    return np.broadcast_to(double(view.background), (view.height, view.width, 3))


def frame(found: Sequence[Layer], view: View) -> Array:
    """The image [H, W, 3] in sRGB from 0 to 255, not rounded."""
    image = background(view)
    for layer in found:
        image = mix(image, layer.color, layer.coverage[..., None], view.linear)
    return image


def blend(images: Sequence[Array], view: View) -> Array:
    """The mean of images of one exposure."""
    if not view.linear:
        return np.mean(images, axis=0)
    return from_light(np.mean([to_light(image) for image in images], axis=0))


def exposed(video: Video, steps: Video, t: int, before: float, per_frame: int, fps: float) -> Video:
    """The video at one instant, `before` frames before frame t, as its only frame.

    `steps` has the states after every step of the solver, `per_frame` of them per frame. Objects move uniformly
    between steps and before frame 0. Centre, scale and angle of the camera are linear between frames.
    """
    time = (t - before) * per_frame
    step = max(0, math.floor(time))
    states = {}
    for name, rate in (("position", "velocity"), ("angle", "angular_velocity")):
        values, rates = double(steps[f"states/{name}"]), double(steps[f"states/{rate}"])
        slope = values[step + 1] - values[step] if time > 0 else rates[0] / (fps * per_frame)
        states[f"states/{name}"] = (values[step] + (time - step) * slope)[None]
    cameras = {}
    for name in ("center", "scale", "angle"):
        values = double(video[f"camera/{name}"])
        last = values[t - 1] if t else 2 * values[0] - values[1]
        cameras[f"camera/{name}"] = (values[t] + before * (last - values[t]))[None]
    return {**video, **states, **cameras}


# ---- Annotations of a mask [H, W]


def visible_boxes(mask: Array, slots: int) -> Array:
    """Boxes x0 y0 x1 y1 [K, 4] around the pixels of each slot; zero where there are none."""
    boxes = np.zeros((slots, 4))
    for slot in range(slots):
        rows, columns = np.nonzero(mask == slot + 1)
        if len(rows):
            boxes[slot] = columns.min(), rows.min(), columns.max() + 1, rows.max() + 1
    return boxes


def visible_pixels(mask: Array, slots: int) -> Array:
    """Number of pixels [K] of each slot."""
    return np.bincount(mask.ravel(), minlength=256)[1 : slots + 1]


def pixel_centers(view: View) -> Array:
    """Positions [H, W, 2] of the centres of all pixels."""
    return np.stack(np.meshgrid(np.arange(view.width), np.arange(view.height)), -1) + 0.5


def moved(video: Video, t: int, to: int, id_: int, pixels: Array, view: View) -> Array:
    """Positions in frame `to` of what is at pixel positions [..., 2] in frame t and belongs to an id."""
    if id_ == OCCLUDER:
        return pixels
    world = to_world(video, t, pixels, view)
    if id_:
        world = from_body(video, to, id_ - 1, to_body(video, t, id_ - 1, world))
    return to_pixels(video, to, world, view)


class Relief(NamedTuple):
    """What of the surfaces of objects is not stored."""

    slope: Array  # K, sine of the steepest tilt, at the rim
    bevel: Array  # K, m, width of the sloping border of polygons


def profile(shape: Outline, polygon: bool, points: Array, width: float) -> Array:
    """Distance [N] px from where a surface is level, over the width that slopes: 1 at the rim, and beyond it."""
    if not polygon:
        return np.minimum(distance(shape.core, points) / width, 1)
    along = np.roll(shape.core, -1, axis=0) - shape.core
    kept = np.linalg.norm(along, axis=-1) > 1e-9
    along, corner = along[kept] / np.linalg.norm(along[kept], axis=-1, keepdims=True), shape.core[kept]
    from_corner = points[:, None] - corner
    offside = np.abs(along[:, 0] * from_corner[..., 1] - along[:, 1] * from_corner[..., 0]).min(-1)
    inside = offside * (distance(shape.core, points) == 0) + shape.radius - distance(shape.core, points)
    return np.clip(1 - inside / width, 0, 1)


def height(video: Video, t: int, slot: int, points: Array, relief: Relief, view: View) -> Array:
    """Height [N] px of an object's surface above its rim, at pixel positions [N, 2]: a cap of a sphere.

    The sphere's radius is such that the cap is as steep at its rim as the surface is.
    """
    shape, polygon = outline(video, t, slot, view), video["objects/shape"][slot] == POLYGON
    bevel = max(float(relief.bevel[slot]) * float(video["camera/scale"][t]), 1.0)
    width, slope = bevel if polygon else max(shape.radius, 0.5), float(relief.slope[slot])
    sphere, away = width / slope, width * profile(shape, bool(polygon), points, width)
    return np.sqrt(sphere**2 - away**2) - math.sqrt(sphere**2 - width**2)


def flow(video: Video, t: int, to: int, mask: Array, view: View) -> Array:
    """Flow [H, W, 2] px of every pixel centre of frame t to frame `to`."""
    centers = pixel_centers(view)
    result = np.zeros_like(centers)
    for id_ in np.unique(mask):
        here = mask == id_
        result[here] = moved(video, t, to, int(id_), centers[here], view) - centers[here]
    return result
