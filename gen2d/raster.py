"""World to pixels: what each slot is painted as becomes uint8 frames, back to front, on the device.

A pixel takes an object's colour in proportion to the exact area that the object covers of it (coverage.py), on sRGB
values, as most tools do, or in linear light; each layer is rounded, as in a frame buffer. The same pass finds which
object each pixel shows most of.

What never moves is drawn once a video. What moves is drawn in one of two forms that give the same image: on a CPU
(`draw_patches`) each object touches a patch of its own size, one after the other, in a loop over frames and objects
(under `vmap` the loop would become a scatter); on a GPU (`draw_dense`) every pixel looks at every object, which fuses.
`draw_soft` is the latter without rounding, for gradients.
"""

import dataclasses
import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gen2d.camera import to_pixels, to_world
from gen2d.figures import Bodies, Cut, Instants, Window, cut, inks_of, painted, parts_of
from gen2d.paint import LINEAR, Paint, hashed, textured, to_linear, to_srgb
from gen2d.types import STATIC, Array, Layout, Run

LANES = 8  # pixels: a patch's rows are whole SIMD vectors
FULL = 2**15 - 1  # a pixel's coverage is a whole number up to this
OCCLUDER = 255  # what a mask says of a pixel that shows an occluder


class Occluders(NamedTuple):
    """Rectangles that stand still in the picture, back to front."""

    box: Array  # [O, 4] px: left, top, right, bottom
    color: Array  # [O, 3] sRGB
    rank: Array  # [O] how many of the moving slots, in drawing order, they stand before


class Stage(NamedTuple):
    """All that one video is drawn from; any number of them have their axes before these."""

    bodies: Bodies
    instants: Instants  # at the T frames
    exposed: Instants | None  # [T, S, ...] at the S instants of each exposure
    paint: Paint
    occluders: Occluders | None
    noise: Array | None  # sRGB, standard deviation
    seed: Array  # uint32, of the noise


@dataclasses.dataclass(frozen=True)
class Plan:
    """What is known of a picture before anything is drawn."""

    layout: Layout
    height: int  # px
    width: int
    scale: float  # px/m at most
    grow: float = 0.0  # px at most, that a look adds to an object's rim
    still: bool = True  # whether the camera never moves
    linear: bool = False  # whether colours mix in linear light
    frames: bool = True  # whether frames are wanted
    owners: bool = False  # whether it is wanted which object each pixel shows
    exposed: int = 0  # instants of an exposure; 0: no motion blur

    @property
    def behind(self) -> list[tuple[Run, int]]:
        """The runs of the unmoving layer, back to front."""
        spans = self.layout.painted
        first = next((i for i, (run, _) in enumerate(spans) if not self.still or run.kind != STATIC), len(spans))
        return list(spans[:first])

    @property
    def groups(self) -> "list[Group]":
        """The others, in groups that share a size of patch."""
        found: list[Group] = []
        for run, first in self.layout.painted[len(self.behind) :]:
            reach = self._reach(run)
            if found and found[-1].reach == reach:
                found[-1] = Group((*found[-1].runs, (run, first)), reach)
            else:
                found.append(Group(((run, first),), reach))
        return found

    def _reach(self, run: Run) -> float:
        """Of an object from its centre, px; as large as the picture where that is not known to be less."""
        reach = self.largest(run)
        return reach if 2 * reach + 2 < max(self.height, self.width) else math.inf

    def largest(self, run: Run) -> float:
        """No disc of a run is larger, px."""
        return math.inf if run.kind == STATIC else self.layout.reach * self.scale + self.grow


class Group(NamedTuple):
    """Runs that are drawn into patches of one size."""

    runs: tuple[tuple[Run, int], ...]
    reach: float  # px

    @property
    def slots(self) -> list[int]:
        """Its slots in drawing order."""
        return [slot for run, first in self.runs for slot in range(first, first + run.count)]

    def size(self, height: int, width: int) -> tuple[int, int]:
        """Rows and columns of a patch."""
        if math.isinf(self.reach):
            return height, width
        side = math.floor(2 * self.reach) + 2
        return min(side, height), min(-(-side // LANES) * LANES, width)


# ---- One layer


class Layer(NamedTuple):
    """What is painted over an image: coverage as whole numbers up to FULL, int16, and a colour, int16."""

    cover: Array  # [..., rows, columns]
    color: Array  # [..., rows, columns, 3], or what broadcasts to it


def whole(cover: Array) -> Array:
    """A coverage from 0 to 1 as whole numbers."""
    return (cover * FULL + 0.5).astype(jnp.int32).astype(jnp.int16)


def over(under: Array, layer: Layer, linear: bool) -> Array:
    """The uint8 image [..., 3] after one more layer."""
    cover, color = layer.cover[..., None], layer.color
    if linear:
        light = jnp.asarray(LINEAR)[under.astype(jnp.int32)]
        share = cover.astype(jnp.float32) * (1 / FULL)
        mixed = light + share * (to_linear(color.astype(jnp.float32)) - light)
        return (to_srgb(mixed) + 0.5).astype(jnp.uint8)
    # Fixed point, so that both forms round alike: 5 bits below one, products of 16 bits, of which a vector has many.
    under = under.astype(jnp.int16)
    apart = (color - under) << 6
    product = ((apart.astype(jnp.int32) * cover.astype(jnp.int32)) >> 16).astype(jnp.int16)
    return (under + ((product + 16) >> 5)).astype(jnp.uint8)


def owned(owner: Array, cover: Array, name: Array | int) -> Array:
    """Who is seen most of in each pixel, after one more layer.

    An owner is an id and, above its 8 bits, how much of the pixel its object shows, up to FULL; what comes on top
    leaves the same share of all that was there, so only the best so far has to be known.
    """
    cover = cover.astype(jnp.int32)
    best = ((owner >> 8) * (FULL - cover) + FULL // 2) // FULL
    return jnp.where(cover > best, (cover << 8) | name, (best << 8) | (owner & 255))


NOBODY = FULL << 8


def _occluder(occluders: Occluders, i: int, height: int, width: int) -> tuple[Array, Array]:
    """Coverage [H, W] and colour [3] of an occluder."""
    left, top, right, bottom = (occluders.box[i, side] for side in range(4))

    def part(count: int, low: Array, high: Array) -> Array:
        edge = jnp.arange(count, dtype=jnp.float32)
        return jnp.clip(jnp.minimum(high, edge + 1) - jnp.maximum(low, edge), 0.0, 1.0)

    return part(height, top, bottom)[:, None] * part(width, left, right), occluders.color[i]


def _ground(stage: Stage, at: Instants, height: int, width: int) -> Array:
    """The background [I, H, W, 3] at some instants, as floats; [1, H, W, 3] where it is the same at all."""
    background, first = stage.paint.background, stage.instants.view
    color = background.color
    if background.to_color is None and background.texture is None:
        return jnp.broadcast_to(color, (1, height, width, 3))
    rows, columns = (jnp.arange(n, dtype=jnp.float32) + 0.5 for n in (height, width))
    rows, columns = (a.reshape(-1) for a in jnp.meshgrid(rows, columns, indexing="ij"))
    x, y = (a.reshape(-1, height, width) for a in to_world(at.view, columns, rows, height, width))
    if background.to_color is not None and background.direction is not None:
        # From one end of what the first frame shows to the other.
        cos, sin = jnp.cos(background.direction), jnp.sin(background.direction)
        center, scale = first.center[0], first.scale[0]
        reach = (jnp.abs(cos) * width + jnp.abs(sin) * height) / (2 * scale)
        along = ((x - center[0]) * cos + (y - center[1]) * sin) / reach
        color = color + jnp.clip((along[..., None] + 1) / 2, 0, 1) * (background.to_color - color)
    if background.texture is not None:
        color = textured(color, background.texture, x, y)
    return jnp.broadcast_to(color, (*x.shape, 3))


def _some(at: Instants, instants: Any) -> Instants:
    return jax.tree.map(lambda a: a[instants], at)


def _ink(color: Array) -> Array:
    return (color + 0.5).astype(jnp.int32).astype(jnp.int16)


def _stills(stage: Stage, plan: Plan) -> "Canvas":
    """What never moves, drawn once, without the instants' axis."""
    at = _some(stage.instants, slice(0, 1))
    height, width = plan.height, plan.width
    image = (_ground(stage, at, height, width) + 0.5).astype(jnp.uint8)
    nobody = jnp.full((1, height, width), NOBODY, jnp.int32)
    canvas = Canvas(image if plan.frames else None, nobody if plan.owners else None)
    bare = stage._replace(occluders=None)  # they stand before what moves
    return jax.tree.map(lambda a: a[0], _all_over(canvas, bare, plan, at, plan.behind))


class Canvas(NamedTuple):
    """Images that are painted on, uint8 [I, H, W, 3] and int32 [I, H, W], if they are wanted."""

    image: Array | None
    owner: Array | None


def _over(canvas: Canvas, layer: Layer, name: Any, linear: bool) -> Canvas:
    image, owner = canvas
    return Canvas(
        None if image is None else over(image, layer, linear),
        None if owner is None else owned(owner, layer.cover, name),
    )


def _all_over(
    canvas: Any, stage: Stage, plan: Plan, at: Instants, runs: list[tuple[Run, int]], paint: Any = None
) -> Any:
    """The canvas after some runs' slots and what stands before them were painted over all of it.

    A loop over the slots: what depends on rows or columns alone is then computed before it, once, and not again for
    every pixel, as it would be where the compiler fused all.
    """
    window = Window(0, 0, plan.height, plan.width)
    paint = paint or functools.partial(_over, linear=plan.linear)
    rank = 0
    for run, first in runs:
        slots = slice(first, first + run.count)

        def all_of(canvas: Any, run: Run = run, first: int = first, slots: slice = slots, rank: int = rank) -> Any:
            def one(canvas: Any, entry: tuple) -> tuple[Any, None]:
                cuts, inks, slot, rank = entry
                canvas = _standing(canvas, stage, plan, lambda of: of == rank, paint)
                layer = Layer(*painted(cuts, inks, window, plan.largest(run)))
                return paint(canvas, _fixed(layer, paint), slot + 1), None

            numbers = jnp.arange(run.count)
            entries = _cut(stage, plan, at, run, first, window), inks_of(stage.paint, slots)
            return jax.lax.scan(one, canvas, (*entries, first + numbers, rank + numbers))[0]

        some = stage.occluders is not None or stage.paint.drawn[slots].any()
        canvas = jax.lax.cond(some, all_of, lambda same: same, canvas)
        rank += run.count
    return canvas


def _cut(stage: Stage, plan: Plan, at: Instants, run: Run, first: int, window: Window) -> Cut:
    """The parts of a run's slots at some instants, cut by their windows; arrays [k, I, ...].

    In a loop of its own, for what is the same for all rows and columns to be there before it.
    """
    parts = parts_of(run, first, stage.bodies, at, stage.paint, plan.height, plan.width)
    toned = stage.paint.shade is not None or stage.paint.texture is not None
    begin = [jnp.broadcast_to(jnp.asarray(edge), parts.turn.column.shape) for edge in (window.top, window.left)]

    def one(entry: tuple) -> Cut:
        of, top, left = entry
        return cut(of, Window(top, left, window.rows, window.columns), run.shape == "circle", toned)

    return jax.lax.map(one, (parts, *begin))


def _fixed(layer: Layer, paint: Any) -> Layer:
    """The layer in fixed point, unless it is painted in floats."""
    return layer if paint in (_softly, _brightly) else Layer(whole(layer.cover), _ink(layer.color))


def _standing(canvas: Any, stage: Stage, plan: Plan, here: Any, paint: Any) -> Any:
    """The canvas after those occluders whose rank is `here`."""
    if stage.occluders is None:
        return canvas
    for i in range(stage.occluders.rank.shape[0]):
        cover, color = _occluder(stage.occluders, i, plan.height, plan.width)
        layer = Layer(jnp.where(here(stage.occluders.rank[i]), cover, 0.0)[None], color)
        canvas = paint(canvas, _fixed(layer, paint), OCCLUDER)
    return canvas


# ---- Every pixel looks at every object


def draw_dense(stages: Stage, plan: Plan) -> tuple[Array | None, Array | None]:
    """Frames [n, T, H, W, 3] uint8 and owners [n, T, H, W] uint8, each if it is wanted. The form for GPUs."""
    return jax.vmap(functools.partial(_dense, plan=plan))(stages)


def _dense(stage: Stage, plan: Plan) -> tuple[Array | None, Array | None]:
    frames = owners = None
    if plan.frames and stage.exposed is None:
        frames = _dense_frames(stage, plan, stage.instants)
    elif plan.frames and stage.exposed is not None:
        exposed = jax.tree.map(lambda a: jnp.moveaxis(a, 1, 0), stage.exposed)

        def add(total: Array, at: Instants) -> tuple[Array, None]:
            return total + _dense_frames(stage, plan, at).astype(jnp.uint16), None

        shape = (stage.instants.angle.shape[0], plan.height, plan.width, 3)
        frames = _averaged(jax.lax.scan(add, jnp.zeros(shape, jnp.uint16), exposed)[0], plan.exposed)
    if frames is not None and stage.noise is not None:
        frames = noisy(frames, stage.noise, stage.seed, jnp.arange(frames.shape[0]))
    if plan.owners:
        owners = _dense_owners(stage, plan)
    return frames, owners


def _dense_frames(stage: Stage, plan: Plan, at: Instants) -> Array:
    if plan.still:
        image = _stills(stage, plan).image
        assert image is not None
    else:
        image = (_ground(stage, at, plan.height, plan.width) + 0.5).astype(jnp.uint8)
    image = jnp.broadcast_to(image, (at.angle.shape[0], plan.height, plan.width, 3))
    canvas = _moving(Canvas(image, None), stage, plan, at)
    assert canvas.image is not None
    return canvas.image


def _dense_owners(stage: Stage, plan: Plan) -> Array:
    start = _stills(stage, plan).owner if plan.still else jnp.full((plan.height, plan.width), NOBODY, jnp.int32)
    assert start is not None
    owner = jnp.broadcast_to(start, (stage.instants.angle.shape[0], plan.height, plan.width))
    canvas = _moving(Canvas(None, owner), stage, plan, stage.instants)
    assert canvas.owner is not None
    return (canvas.owner & 255).astype(jnp.uint8)


def _moving(canvas: Any, stage: Stage, plan: Plan, at: Instants, paint: Any = None) -> Any:
    """The canvas after what moves and the occluders between."""
    paint = paint or functools.partial(_over, linear=plan.linear)
    runs = [span for group in plan.groups for span in group.runs]
    canvas = _all_over(canvas, stage, plan, at, runs, paint)
    count = sum(run.count for run, _ in runs)
    return _standing(canvas, stage, plan, lambda rank: rank >= count, paint)


def alone(stage: Stage, plan: Plan, measure: Any) -> Array:
    """What `measure` makes of the coverage [T, H, W] of each slot as if it were alone, [T, K, ...]."""
    window, found = Window(0, 0, plan.height, plan.width), []
    for run, first in plan.layout.spans:
        stands = plan.still and run.kind == STATIC
        cuts = _cut(stage, plan, _some(stage.instants, slice(0, 1 if stands else None)), run, first, window)
        inks = inks_of(stage.paint, slice(first, first + run.count))
        largest = plan.largest(run)
        made = jax.lax.map(lambda one, most=largest: measure(painted(one[0], one[1], window, most)[0]), (cuts, inks))
        found.append(jnp.broadcast_to(made, (run.count, len(stage.instants.angle), *made.shape[2:])))
    return jnp.moveaxis(jnp.concatenate(found), 0, 1)


def _averaged(total: Array, count: int) -> Array:
    return ((total + count // 2) // count).astype(jnp.uint8)


def noisy(frames: Array, deviation: Array, seed: Array, numbers: Array) -> Array:
    """The frames [T, H, W, 3] with Gaussian noise of a sensor: for each value four random bytes, whose sum has a
    variance of (256^2 - 1) / 3."""
    places = jnp.arange(math.prod(frames.shape[1:]), dtype=jnp.uint32).reshape(frames.shape[1:])
    word = hashed(seed, numbers[:, None, None, None], places)
    total = functools.reduce(jnp.add, [((word >> shift) & 255).astype(jnp.int32) for shift in (0, 8, 16, 24)])
    spread = (total - 510).astype(jnp.float32) * (deviation / math.sqrt((256**2 - 1) / 3))
    return jnp.clip(jnp.floor(frames.astype(jnp.float32) + spread + 0.5), 0, 255).astype(jnp.uint8)


def draw_soft(stage: Stage, plan: Plan) -> Array:
    """One video's frames [T, H, W, 3] as floats, 0 to 255, without rounding, noise or motion blur: what the others give
    but for rounding, and differentiable in places, angles, sizes, colours and the camera."""
    image = _ground(stage, stage.instants, plan.height, plan.width)
    image = jnp.broadcast_to(to_linear(image) if plan.linear else image, (len(stage.instants.angle), *image.shape[1:]))
    paint = _brightly if plan.linear else _softly
    image = _all_over(image, stage._replace(occluders=None), plan, stage.instants, plan.behind, paint)
    image = _moving(image, stage, plan, stage.instants, paint)
    return to_srgb(image) if plan.linear else image


def _softly(image: Array, layer: Layer, name: Any) -> Array:
    """The image of floats after one more layer."""
    return image + layer.cover[..., None] * (layer.color - image)


def _brightly(light: Array, layer: Layer, name: Any) -> Array:
    """The same in linear light."""
    return _softly(light, Layer(layer.cover, to_linear(layer.color)), name)


# ---- Each object touches a patch of its own


class Patches(NamedTuple):
    """A group's slots, cut by the pixels of their patches, at all instants; arrays [k, I, ...]."""

    group: Group
    window: Window
    cuts: list[Cut]  # of each run


class Strokes(NamedTuple):
    """The patches of a group's slots in one frame."""

    cover: Array  # [k, rows, columns] int16
    color: Array  # [k, rows or 1, columns or 1, 3] int16
    top: Array  # [k]
    left: Array


def draw_patches(stages: Stage, plan: Plan) -> tuple[Array | None, Array | None]:
    """The same as `draw_dense`, each object drawn into a patch of its size. The form for CPUs."""
    videos, frames = stages.instants.angle.shape[:2]
    stills = jax.lax.map(functools.partial(_stills, plan=plan), stages)
    shape = videos, frames, plan.height, plan.width
    start = None if stills.image is None else jnp.broadcast_to(stills.image[:, None], (*shape, 3))
    plain = plan.still and not plan.exposed and stages.noise is None
    owners = jnp.zeros((videos * frames, *shape[2:]), jnp.uint8) if plan.owners else None
    canvas = Canvas(None if start is None else start.reshape(-1, *shape[2:], 3), owners)

    def video(v: Array, canvas: Canvas) -> Canvas:
        stage = jax.tree.map(lambda a: jax.lax.dynamic_index_in_dim(a, v, keepdims=False), stages)
        back = jax.tree.map(lambda a: jax.lax.dynamic_index_in_dim(a, v, keepdims=False), stills)
        draw = _Patches(stage, plan, back, v * frames)
        if plan.frames and plain:
            canvas = draw.straight(canvas)
        elif plan.frames:
            canvas = draw.apart(canvas)
        return draw.owners(canvas) if plan.owners and not (plan.frames and plain) else canvas

    canvas = jax.lax.fori_loop(0, videos, video, canvas)
    return tuple(jax.tree.map(lambda a: a.reshape(videos, frames, *a.shape[1:]), canvas))


class _Patches:
    """Draws one video, frame by frame."""

    def __init__(self, stage: Stage, plan: Plan, back: Canvas, first: Array) -> None:
        self.stage, self.plan, self.back, self.first = stage, plan, back, first
        self.frames = stage.instants.angle.shape[0]

    def straight(self, canvas: Canvas) -> Canvas:
        """Frames, and owners if wanted, drawn where they belong, on unmoving layers that are there already."""
        cuts = self._cuts(self.stage.instants)

        def frame(t: Array, canvas: Canvas) -> Canvas:
            owner = None if self.back.owner is None else self.back.owner[None]
            image, owner = self._painted(Canvas(canvas.image, owner), self.first + t, cuts, t)
            return Canvas(image, self._kept(canvas.owner, owner, t))

        return jax.lax.fori_loop(0, self.frames, frame, canvas)

    def owners(self, canvas: Canvas) -> Canvas:
        """Owners alone."""
        cuts = self._cuts(self.stage.instants)
        start = self.back.owner if self.plan.still else jnp.full((self.plan.height, self.plan.width), NOBODY, jnp.int32)
        assert start is not None

        def frame(t: Array, canvas: Canvas) -> Canvas:
            owner = self._painted(Canvas(None, start[None]), jnp.int32(0), cuts, t).owner
            return Canvas(canvas.image, self._kept(canvas.owner, owner, t))

        return jax.lax.fori_loop(0, self.frames, frame, canvas)

    def _kept(self, owners: Array | None, owner: Array | None, t: Array) -> Array | None:
        if owners is None or owner is None:
            return owners
        return jax.lax.dynamic_update_slice(owners, (owner & 255).astype(jnp.uint8), (self.first + t, 0, 0))

    def apart(self, canvas: Canvas) -> Canvas:
        """Frames drawn on an image of their own: exposed more than once, with a camera that moves, or noisy."""
        stage, plan = self.stage, self.plan
        shown = stage.instants if stage.exposed is None else jax.tree.map(_flat, stage.exposed)
        samples, cuts = max(plan.exposed, 1), self._cuts(shown)

        def once(i: Array) -> Array:
            if plan.still:
                assert self.back.image is not None
                start = self.back.image[None]
            else:
                at = jax.tree.map(lambda a: jax.lax.dynamic_slice_in_dim(a, i, 1), shown)
                start = (_ground(stage, at, plan.height, plan.width) + 0.5).astype(jnp.uint8)
            image = self._painted(Canvas(start, None), jnp.int32(0), cuts, i).image
            assert image is not None
            return image

        def frame(t: Array, canvas: Canvas) -> Canvas:
            if plan.exposed:
                total = jnp.zeros((1, plan.height, plan.width, 3), jnp.uint16)
                add = lambda s, total: total + once(t * samples + s).astype(jnp.uint16)  # noqa: E731
                image = _averaged(jax.lax.fori_loop(0, samples, add, total), samples)
            else:
                image = once(t)
            if stage.noise is not None:
                image = noisy(image, stage.noise, stage.seed, t[None])
            assert canvas.image is not None
            return Canvas(jax.lax.dynamic_update_slice(canvas.image, image, (self.first + t, 0, 0, 0)), canvas.owner)

        return jax.lax.fori_loop(0, self.frames, frame, canvas)

    def _cuts(self, at: Instants) -> "list[Patches]":
        """What of each group depends on rows or columns alone, for all instants."""
        found = []
        for group in self.plan.groups:
            windows = [patch_of(self.plan, group, at, run, first) for run, first in group.runs]
            spans = zip(group.runs, windows, strict=True)
            cuts = [_cut(self.stage, self.plan, at, run, first, window) for (run, first), window in spans]
            top, left = (_joined([getattr(w, edge) for w in windows]) for edge in ("top", "left"))
            found.append(Patches(group, Window(top, left, windows[0].rows, windows[0].columns), cuts))
        return found

    def _painted(self, canvas: Canvas, frame: Array, cuts: "list[Patches]", i: Array) -> Canvas:
        """The canvas with instant i of all that moves painted into its frame; owners have but one frame."""
        rank = 0
        last = sum(len(patches.group.slots) for patches in cuts)
        for patches in cuts:
            group, strokes = patches.group, self._strokes(patches, i)
            names = jnp.asarray(group.slots, jnp.int32) + 1
            stroke = functools.partial(self._stroke, strokes=strokes, names=names, frame=frame)
            if self.stage.occluders is None:
                canvas = jax.lax.fori_loop(0, len(group.slots), stroke, canvas)
            else:
                canvas = self._interleaved(
                    canvas, stroke, rank, len(group.slots), frame, rank + len(group.slots) == last
                )
            rank += len(group.slots)
        return canvas

    def _strokes(self, patches: "Patches", i: Array) -> Strokes:
        def pick(a: Array) -> Array:
            return jax.lax.dynamic_index_in_dim(a, i, 1, keepdims=False)

        covers, colors = [], []
        for (run, first), cuts in zip(patches.group.runs, patches.cuts, strict=True):
            inks = inks_of(self.stage.paint, slice(first, first + run.count))
            cover, color = painted(jax.tree.map(pick, cuts), inks, patches.window, self.plan.largest(run))
            covers.append(whole(cover))
            colors.append(_ink(color))
        shape = jnp.broadcast_shapes(*(color.shape[1:] for color in colors))
        colors = [jnp.broadcast_to(color, (color.shape[0], *shape)) for color in colors]
        return Strokes(_joined(covers), _joined(colors), pick(patches.window.top), pick(patches.window.left))

    def _stroke(self, k: Array, canvas: Canvas, strokes: Strokes, names: Array, frame: Array) -> Canvas:
        cover = jax.lax.dynamic_index_in_dim(strokes.cover, k)
        color = jax.lax.dynamic_index_in_dim(strokes.color, k)
        return self._put(canvas, Layer(cover, color), names[k], frame, strokes.top[k], strokes.left[k])

    def _put(self, canvas: Canvas, layer: Layer, name: Any, frame: Array, top: Any, left: Any) -> Canvas:
        image, owner = canvas
        if image is not None:
            place = (frame, top, left, 0)
            under = jax.lax.dynamic_slice(image, place, (*layer.cover.shape, 3))
            image = jax.lax.dynamic_update_slice(image, over(under, layer, self.plan.linear), place)
        if owner is not None:
            place = (0, top, left)
            under = jax.lax.dynamic_slice(owner, place, layer.cover.shape)
            owner = jax.lax.dynamic_update_slice(owner, owned(under, layer.cover, name), place)
        return Canvas(image, owner)

    def _interleaved(self, canvas: Canvas, stroke: Any, rank: int, count: int, frame: Array, ends: bool) -> Canvas:
        """The strokes with the occluders between them."""
        occluders = self.stage.occluders
        assert occluders is not None
        done: Any = 0
        for i in range(occluders.rank.shape[0]):
            until = jnp.clip(occluders.rank[i] - rank, 0, count)
            canvas = jax.lax.fori_loop(done, until, stroke, canvas)
            done = until
            here = (occluders.rank[i] >= rank) & ((occluders.rank[i] < rank + count) | ends)
            cover, color = _occluder(occluders, i, self.plan.height, self.plan.width)
            layer = Layer(whole(jnp.where(here, cover, 0.0))[None], _ink(color))
            canvas = self._put(canvas, layer, OCCLUDER, frame, 0, 0)
        return jax.lax.fori_loop(done, count, stroke, canvas)


def _flat(a: Array) -> Array:
    return a.reshape(-1, *a.shape[2:])


def patch_of(plan: Plan, group: Group, at: Instants, run: Run, first: int) -> Window:
    """The patches of a run's slots at some instants, top and left [k, I]."""
    height, width = plan.height, plan.width
    rows, columns = group.size(height, width)
    places = to_pixels(at.view, at.position[:, first : first + run.count], height, width)

    def begin(center: Array, size: int, whole: int) -> Array:
        if size == whole:
            return jnp.zeros(center.T.shape, jnp.int32)
        return jnp.clip(jnp.floor(center.T - group.reach).astype(jnp.int32), 0, whole - size)

    return Window(begin(places[..., 1], rows, height), begin(places[..., 0], columns, width), rows, columns)


def _joined(arrays: list[Array]) -> Array:
    return arrays[0] if len(arrays) == 1 else jnp.concatenate(arrays)


def draw(stages: Stage, plan: Plan) -> tuple[Array | None, Array | None]:
    """Frames [n, T, H, W, 3] uint8 and owners [n, T, H, W] uint8, each if it is wanted, in the form for this device."""
    return (draw_patches if on_cpu() else draw_dense)(stages, plan)


def on_cpu() -> bool:
    """Whether programs run on a CPU, for which small loops are best, rather than on a GPU."""
    return jax.default_backend() == "cpu"
