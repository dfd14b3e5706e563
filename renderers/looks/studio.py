"""Bodies under a lamp: domes and bevels of some material, highlights, soft shadows, and a backdrop."""

import dataclasses
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.plugin import (
    LINES,
    POLYGON,
    Array,
    Background,
    Distribution,
    Layout,
    Light,
    Look,
    Paint,
    Pattern,
    PlainOptions,
    Scene,
    Shadow,
    Surface,
    are_lines,
    are_moving,
    backdrop,
    line_margin,
    minimum,
    option,
    palette_option,
    plain,
    sampled_options,
)

LIFT = 0.4  # height of the bodies above the background, over the size of a typical one
BLUR = 0.35  # half width of the soft edges of shadows, over the same
BEVEL = 0.3  # width of the bevel of polygons, over the same
FLATTER = 0.6  # slope of bevels and lines, over that of other domes
WHITE, DARK = (246.0, 242.0, 233.0), (40.0, 28.0, 20.0)  # colours of highlights and stripes, and of shadows
PALE = 200.0  # mean sRGB value from which an object's stripe is darker than the object


class Finish(NamedTuple):
    """Properties of a material, or of the slots [K]; the pattern's cell is over the size of a typical body."""

    gloss: Any  # of the option
    sharpness: Any
    slope: Any
    striped: Any = 0.0
    cell: Any = 1.0
    stretch: Any = 1.0
    contrast: Any = 0.0
    mirror: Any = 0.0
    number: Any = 0.0  # in MATERIALS


MATERIALS = {
    "rubber": Finish(1.2, 40.0, 0.95, striped=1.0),
    "wood": Finish(0.15, 12.0, 0.9, cell=0.35, stretch=8.0, contrast=1.0),
    "metal": Finish(1.5, 60.0, 0.95, cell=0.05, stretch=20.0, contrast=0.15, mirror=0.85),
    "paper": Finish(0.0, 10.0, 0.3, cell=0.12, contrast=0.25),
}


@dataclasses.dataclass(frozen=True)
class Options(PlainOptions):
    """Options of light, materials and shadows, in addition to those of plain shapes."""

    materials: ClassVar[tuple[str, ...]] = (*MATERIALS,)
    wall_width: float = option(3.0, float, "px", "line width of segments beyond their radius; 0: not drawn", low=0)
    palette: str = palette_option("paper")
    material: tuple[str, ...] = option(
        ("rubber",), str, "", "material of the objects; from a list, one for each object", choices=(*MATERIALS,),
        several=True,
    )  # fmt: skip
    material_by: str = option(
        "random", str, "", "whether materials are random, or in equal parts of an object's property from 0 to 1",
        choices=("random", "elasticity", "friction"), later=True,
    )  # fmt: skip
    stripe: float = option(0.22, float, "1", "half width of the stripe of rubber discs, over the radius", low=0, high=1)
    azimuth: Distribution = option(
        2.2, float, "rad", "direction of the light, counter-clockwise from the right",
        draw=True, low=-10, high=10,
    )  # fmt: skip
    elevation: Distribution = option(
        0.75, float, "rad", "elevation of the light above the plane of motion",
        draw=True, low=0.2, high=1.57,
    )  # fmt: skip
    softness: Distribution = option(
        0.3, float, "1", "width of the transition from light to dark, as a cosine",
        draw=True, low=0.01, high=2,
    )  # fmt: skip
    ambient: Distribution = option(
        0.3, float, "1", "part of ambient light",
        draw=True, low=0, high=1,
    )  # fmt: skip
    gloss: Distribution = option(
        0.45, float, "1", "strength of highlights, of which a material has a part or a multiple",
        draw=True, low=0, high=0.6,
    )  # fmt: skip
    shadow: Distribution = option(
        0.4, float, "1", "opacity of shadows",
        draw=True, low=0, high=1,
    )  # fmt: skip


def blur(options: Options, layout: Layout) -> float:
    """Half width in m of the soft edges of shadows."""
    return BLUR * _size(layout)


def _size(layout: Layout) -> float:
    """Size of a typical body in m: the reach of the largest, or a tenth of the view's shorter side if that is less."""
    left, bottom, right, top = layout.bounds
    return minimum(layout.reach, 0.1 * minimum(right - left, top - bottom))


def paint(scene: Scene, layout: Layout, options: Options, key: Array) -> Paint:
    """Paint of one video; static objects are of the first material, without a stripe."""
    base = plain(scene, layout, options, key)
    light_key, material_key, seed_key = jax.random.split(jax.random.fold_in(key, 4), 3)
    drawn = sampled_options(options, light_key)
    flat, high = jnp.cos(drawn["elevation"]), jnp.sin(drawn["elevation"])
    direction = jnp.stack([flat * jnp.cos(drawn["azimuth"]), flat * jnp.sin(drawn["azimuth"]), high])
    light = Light(direction, drawn["softness"], drawn["ambient"], jnp.asarray(WHITE))
    moving = jnp.asarray(are_moving(layout))
    material = _materials(options, scene, moving, material_key)
    gloss = drawn["gloss"] * material.gloss * jnp.where(are_lines(scene), 0.3, 1.0)
    flatter = are_lines(scene) | (scene.objects.shape == POLYGON)
    slope = material.slope * jnp.where(flatter, FLATTER, 1.0)
    surface = Surface(slope, jnp.full(layout.slots, BEVEL * _size(layout)), gloss, material.sharpness)
    if options.stripe and "rubber" in options.material:
        bright = jnp.where(base.color.mean(-1) > PALE, -0.4, 1.0)
        surface = surface._replace(
            stripe=jnp.where(moving, options.stripe * material.striped, 0.0), stripe_light=bright
        )
    if any(MATERIALS[name].contrast for name in options.material):
        seed = jax.random.bits(seed_key, (layout.slots,), jnp.uint32)
        pattern = Pattern(seed, material.cell * _size(layout), material.stretch, material.contrast)
        surface = surface._replace(pattern=pattern)
    if "metal" in options.material:
        surface = surface._replace(mirror=material.mirror)
    offset = -direction[:2] / high * (LIFT * _size(layout))
    shadow = Shadow(offset, jnp.float32(1) * blur(options, layout), drawn["shadow"], jnp.asarray(DARK))
    number = material.number.astype(jnp.uint8)
    background = _backdrop(base, layout, options, key, drawn["azimuth"])
    board = MATERIALS[options.material[0]]
    shape = jnp.float32(FLATTER * board.slope), jnp.float32(1) * BEVEL * _size(layout)
    screen = Surface(*shape, drawn["gloss"] * board.gloss, jnp.float32(board.sharpness))
    return base._replace(
        background=background, light=light, surface=surface, shadow=shadow, screen=screen, material=number,
        sampled=drawn,
    )  # fmt: skip


def _materials(options: Options, scene: Scene, moving: Array, key: Array) -> Finish:
    """Materials of the slots, at random or by a property of the objects; arrays [K]."""
    finishes = [MATERIALS[name]._replace(number=options.materials.index(name)) for name in options.material]
    table = np.asarray(finishes, np.float32)
    if options.material_by == "random":
        chosen = jax.random.randint(key, moving.shape, 0, len(table))
    else:
        share = jnp.clip(getattr(scene.objects, options.material_by), 0.0, 1.0)
        chosen = jnp.minimum((share * len(table)).astype(jnp.int32), len(table) - 1)
    return Finish(*jnp.asarray(table)[jnp.where(moving, chosen, 0)].T)


def _backdrop(base: Paint, layout: Layout, options: Options, key: Array, azimuth: Array) -> Background:
    """The background that is asked for, or the backdrop of the palette: a gradient towards the light, and corners."""
    named = options.named_palette
    if named is None or options.background is not None or options.background_kind != "plain":
        return base.background
    return backdrop(named, layout, jax.random.fold_in(key, 1))._replace(direction=azimuth)


LOOK = Look(options=Options, paint=paint, margin=line_margin, grown=LINES, blur=blur, parts=("surface", "shadow"))
