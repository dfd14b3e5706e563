"""Many discs, boxes and capsules that fall into a bin and come to rest."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.plugin import (
    STATIC,
    Array,
    Bodies,
    Distribution,
    Family,
    Layout,
    SampledScene,
    SlotGroup,
    builder,
    common,
    maximum,
    option,
    place,
)

TURN = [-math.pi, math.pi]
KINDS = ("discs", "boxes", "capsules")


@dataclasses.dataclass(frozen=True)
class Options:
    """The objects and the bin."""

    discs: Distribution = common.count("discs", [2, 8])
    boxes: Distribution = common.count("boxes", [2, 6])
    capsules: Distribution = common.count("capsules", [2, 6])
    width: float = common.size("width of the bin, inside", 6.0)
    height: float = common.size("height of the bin, inside; objects begin at all heights", 9.0)
    disc_radius: Distribution = common.radius("each disc", [0.25, 0.5], each="discs")
    box_size: tuple[Distribution, ...] = option(
        [[0.4, 0.9]] * 2, float, "m", "width and height of each box", parts=2, low=1e-3, draw=True, each="boxes"
    )
    capsule_radius: Distribution = common.radius("each capsule", [0.15, 0.3], each="capsules")
    capsule_half_length: Distribution = common.length(
        "half the distance between the ends' centres", [0.15, 0.4],
        each="capsules", low=1e-3,
    )  # fmt: skip
    box_angle: Distribution = common.angle("angle of each box at the start", TURN, each="boxes")
    capsule_angle: Distribution = common.angle("angle of each capsule at the start", TURN, each="capsules")
    density: Distribution = common.density("every object")
    elasticity: Distribution = common.elasticity("every object", [0.0, 0.5])
    friction: Distribution = common.friction("every object", [0.2, 0.8])
    bin_elasticity: Distribution = common.elasticity("the bin", 0.5)
    bin_friction: Distribution = common.friction("the bin", 0.6)
    gravity: tuple[Distribution, ...] = common.gravity()
    disc_color: tuple[Distribution, ...] = common.color("each disc", each="discs")
    box_color: tuple[Distribution, ...] = common.color("each box", each="boxes")
    capsule_color: tuple[Distribution, ...] = common.color("each capsule", each="capsules")


def reach(options: Options) -> float:
    """Largest distance of an object's boundary from its centre, m."""
    stadium = options.capsule_radius.support[1] + options.capsule_half_length.support[1]
    width, height = (side.support[1] for side in options.box_size)
    return maximum(options.disc_radius.support[1], np.hypot(width, height) / 2, stadium)


def check(options: Options) -> None:
    """Raise ValueError if the bin cannot hold an object."""
    if not 2 * reach(options) < min(options.width, options.height):
        raise ValueError(
            f"disc_radius, box_size and capsule_half_length allow an object {2 * reach(options):g} m across, but it "
            f"must fit a bin of {options.width:g} x {options.height:g} m"
        )


def layout(options: Options) -> Layout:
    """The discs, the boxes, the capsules, then floor, right wall, ceiling, left wall."""
    most = [int(counted.support[1]) for counted in (options.discs, options.boxes, options.capsules)]
    groups = (
        SlotGroup("circle", most[0]),
        SlotGroup("polygon", most[1], vertices=4),
        SlotGroup("capsule", most[2]),
        SlotGroup("segment", 4, STATIC),
    )
    return Layout(groups, (0.0, 0.0, options.width, options.height), reach(options))


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and initial state: all objects at rest in the air, far enough apart for any angle."""
    radius, size, half = factors["disc_radius"], factors["box_size"], factors["capsule_half_length"]
    kinds = ("discs", "boxes", "capsules")
    radii_of = [radius, jnp.linalg.norm(size, axis=-1) / 2, half + factors["capsule_radius"]]
    present_of = [jnp.arange(len(r)) < factors[kind] for r, kind in zip(radii_of, kinds, strict=True)]
    radii, present = jnp.concatenate(radii_of), jnp.concatenate(present_of)
    room = jnp.asarray([options.width, options.height])
    positions, rejected, fits = place(jax.random.fold_in(key, 0), radii, present, jnp.zeros(2), room)
    positions_of = jnp.split(positions, [len(present_of[0]), len(present_of[0]) + len(present_of[1])])
    disc, box, capsule = (
        builder.material(factors) | builder.material(factors, of) for of in ("disc", "box", "capsule")
    )
    parts = [
        builder.discs(positions_of[0], radius, present_of[0], **disc),
        builder.boxes(positions_of[1], factors["box_angle"], size[:, 0], size[:, 1], present_of[1], **box),
        builder.capsules(
            positions_of[2], factors["capsule_angle"], half, factors["capsule_radius"], present_of[2], **capsule
        ),
        builder.box_walls(options.width, options.height, **builder.material(factors, "bin")),
    ]
    return SampledScene(*builder.assemble(layout(options), parts, factors["gravity"]), rejected, fits)


FAMILY = Family(
    options=Options,
    layout=layout,
    sample=sample,
    check=check,
    bodies={
        "discs": Bodies("circle", ("disc_radius",), bears=KINDS),
        "boxes": Bodies("box", ("box_size",), bears=KINDS),
        "capsules": Bodies("capsule", ("capsule_radius", "capsule_half_length"), bears=KINDS),
    },
    crowded_by=("discs", "boxes", "capsules", "disc_radius", "box_size", "capsule_half_length", "width", "height"),
)
