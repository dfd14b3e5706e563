"""Many objects, discs, boxes and capsules, that fall into a bin and come to rest."""

import dataclasses
import math

import jax
import jax.numpy as jnp

from gen2d.plugin import (
    STATIC,
    Array,
    Distribution,
    Family,
    Layout,
    SampledScene,
    SlotGroup,
    assemble,
    box_walls,
    boxes,
    capsules,
    discs,
    option,
    place,
)

COLOR = [[90, 254]] * 3
TURN = [-math.pi, math.pi]


@dataclasses.dataclass(frozen=True)
class Options:
    """What is drawn at random, and the bin."""

    discs: Distribution = option([2, 8], int, "discs", "in a video", low=1, high=64, draw=True)
    boxes: Distribution = option([2, 6], int, "boxes", "in a video", low=1, high=64, draw=True)
    capsules: Distribution = option([2, 6], int, "capsules", "in a video", low=1, high=64, draw=True)
    width: float = option(6.0, float, "m", "of the bin, inside", above=0, high=1000)
    height: float = option(9.0, float, "m", "of the bin, inside; objects begin at all heights", above=0, high=1000)
    disc_radius: Distribution = option([0.25, 0.5], float, "m", "of each disc", low=1e-3, draw=True, each="discs")
    box_size: tuple[Distribution, ...] = option(
        [[0.4, 0.9]] * 2, float, "m", "width and height of each box", parts=2, low=1e-3, draw=True, each="boxes"
    )
    capsule_radius: Distribution = option(
        [0.15, 0.3], float, "m", "of each capsule", low=1e-3, draw=True, each="capsules"
    )
    capsule_half_length: Distribution = option(
        [0.15, 0.4], float, "m", "of each capsule, between the centres of its ends", low=1e-3,
        draw=True, each="capsules",
    )  # fmt: skip
    box_angle: Distribution = option(TURN, float, "rad", "of each box at the start", draw=True, each="boxes")
    capsule_angle: Distribution = option(TURN, float, "rad", "of each capsule at the start", draw=True, each="capsules")
    density: Distribution = option(1.0, float, "kg/m^2", "of every object", low=1e-6, high=1e6, draw=True)
    elasticity: Distribution = option([0.0, 0.5], float, "1", "of every object", low=0, high=1, draw=True)
    friction: Distribution = option([0.2, 0.8], float, "1", "of every object", low=0, high=100, draw=True)
    bin_elasticity: Distribution = option(0.5, float, "1", "of the bin", low=0, high=1, draw=True)
    bin_friction: Distribution = option(0.6, float, "1", "of the bin", low=0, high=100, draw=True)
    gravity: tuple[Distribution, ...] = option(
        [0, -9.8], float, "m/s^2", "x right, y up; the same for a whole video", parts=2, draw=True
    )
    disc_color: tuple[Distribution, ...] = option(
        COLOR, int, "sRGB", "of each disc", parts=3, draw=True, low=0, high=255, each="discs"
    )
    box_color: tuple[Distribution, ...] = option(
        COLOR, int, "sRGB", "of each box", parts=3, draw=True, low=0, high=255, each="boxes"
    )
    capsule_color: tuple[Distribution, ...] = option(
        COLOR, int, "sRGB", "of each capsule", parts=3, draw=True, low=0, high=255, each="capsules"
    )


def reach(options: Options) -> float:
    """The largest distance of a rim from its centre, m."""
    stadium = options.capsule_radius.support[1] + options.capsule_half_length.support[1]
    return max(options.disc_radius.support[1], math.hypot(*(side.support[1] for side in options.box_size)) / 2, stadium)


def check(options: Options) -> None:
    """ValueError where the bin cannot hold an object."""
    if not 2 * reach(options) < min(options.width, options.height):
        raise ValueError(
            f"disc_radius, box_size and capsule_half_length allow an object {2 * reach(options):g} m across, but it "
            f"must fit a bin of {options.width:g} x {options.height:g} m"
        )


def layout(options: Options) -> Layout:
    """The discs, the boxes, the capsules, then floor, right wall, ceiling, left wall."""
    most = [int(counted.support[1]) for counted in (options.discs, options.boxes, options.capsules)]
    runs = (
        SlotGroup("circle", most[0]),
        SlotGroup("polygon", most[1], vertices=4),
        SlotGroup("capsule", most[2]),
        SlotGroup("segment", 4, STATIC),
    )
    return Layout(runs, (0.0, 0.0, options.width, options.height), reach(options))


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and start: everything at rest in the air, so far apart that it may be turned as it likes."""
    radius, size, half = factors["disc_radius"], factors["box_size"], factors["capsule_half_length"]
    kinds = ("discs", "boxes", "capsules")
    around = [radius, jnp.linalg.norm(size, axis=-1) / 2, half + factors["capsule_radius"]]
    there = [jnp.arange(len(r)) < factors[kind] for r, kind in zip(around, kinds, strict=True)]
    box = jnp.asarray([options.width, options.height])
    places, rejected, fits = place(
        jax.random.fold_in(key, 0), jnp.concatenate(around), jnp.concatenate(there), jnp.zeros(2), box
    )
    at = jnp.split(places, [len(there[0]), len(there[0]) + len(there[1])])
    material = {name: factors[name] for name in ("density", "elasticity", "friction")}
    walls = {"elasticity": factors["bin_elasticity"], "friction": factors["bin_friction"]}
    parts = [
        discs(at[0], radius, there[0], color=factors["disc_color"], **material),
        boxes(at[1], factors["box_angle"], size[:, 0], size[:, 1], there[1], color=factors["box_color"], **material),
        capsules(
            at[2], factors["capsule_angle"], half, factors["capsule_radius"], there[2],
            color=factors["capsule_color"], **material,
        ),
        box_walls(options.width, options.height, **walls),
    ]  # fmt: skip
    return SampledScene(*assemble(layout(options), parts, factors["gravity"]), rejected, fits)


FAMILY = Family(
    options=Options,
    layout=layout,
    sample=sample,
    check=check,
    crowded_by=("discs", "boxes", "capsules", "disc_radius", "box_size", "capsule_half_length", "width", "height"),
)
