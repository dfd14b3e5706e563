"""Balls dropped through a lattice of pegs into bins: Galton's board."""

import dataclasses
import math

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
    discs,
    option,
    segments,
)


@dataclasses.dataclass(frozen=True)
class Options:
    """What is drawn at random, and the board."""

    balls: Distribution = option([1, 3], int, "balls", "one above the other", low=1, high=64, draw=True)
    rows: int = option(
        5, int, "rows", "of pegs, each half a spacing beside the last; there is one bin more", low=1, high=12
    )
    spacing: float = option(1.0, float, "m", "of pegs that are neighbours, in and between rows", above=0, high=100)
    peg_radius: float = option(0.18, float, "m", "of each peg", above=0)
    bin_height: float = option(1.8, float, "m", "of the bins", above=0, high=1000)
    apart: float = option(0.9, float, "m", "from one ball's centre to the next one's at the start", above=0)
    radius: Distribution = option([0.2, 0.26], float, "m", "of each ball", low=1e-3, draw=True, each="balls")
    jitter: Distribution = option(
        [-0.15, 0.15], float, "m", "of each ball at the start, right of the middle", draw=True, each="balls"
    )
    density: Distribution = option(1.0, float, "kg/m^2", "of each ball", low=1e-6, high=1e6, draw=True, each="balls")
    elasticity: Distribution = option([0.5, 0.9], float, "1", "of each ball", low=0, high=1, draw=True, each="balls")
    friction: Distribution = option(0.2, float, "1", "of each ball", low=0, high=100, draw=True, each="balls")
    board_elasticity: Distribution = option([0.5, 0.8], float, "1", "of pegs and bins", low=0, high=1, draw=True)
    board_friction: Distribution = option(0.2, float, "1", "of pegs and bins", low=0, high=100, draw=True)
    gravity: tuple[Distribution, ...] = option(
        [0, -9.8], float, "m/s^2", "x right, y up; the same for a whole video", parts=2, draw=True
    )
    color: tuple[Distribution, ...] = option(
        [[90, 254]] * 3, int, "sRGB", "of each ball", parts=3, draw=True, low=0, high=255, each="balls"
    )
    peg_color: tuple[Distribution, ...] = option([150] * 3, int, "sRGB", "of pegs", parts=3, draw=True, low=0, high=255)


def check(options: Options) -> None:
    """ValueError where a ball does not fit between pegs, or two touch at the start."""
    largest, room = options.radius.support[1], options.spacing - 2 * options.peg_radius
    if not 2 * largest < room:
        raise ValueError(f"radius may be {largest:g} m, but a ball must fit between pegs {room:g} m apart")
    if not 2 * largest < options.apart:
        raise ValueError(f"apart is {options.apart:g} m, but must be above the diameter of a ball, {2 * largest:g} m")
    aside = max(map(abs, options.jitter.support))
    if not aside + largest < width(options) / 2:
        raise ValueError(f"jitter may be {aside:g} m to a side, but a ball must fit a board of {width(options):g} m")


def width(options: Options) -> float:
    """Of the board, m."""
    return (options.rows + 1) * options.spacing


def top_peg(options: Options) -> float:
    """How high the first row of pegs is, m; the last is half a spacing above the bins."""
    return options.bin_height + options.spacing * (0.5 + math.sqrt(0.75) * (options.rows - 1))


def pegs(options: Options) -> list[tuple[float, float]]:
    """Their centres, m, in rows from the top; those of the last stand above the walls between bins.

    No peg is nearer to a wall than a spacing, so that no ball is caught there.
    """
    half, down = options.spacing / 2, math.sqrt(0.75) * options.spacing
    halves = range(2, 2 * options.rows + 1)
    return [
        (i * half, top_peg(options) - row * down)
        for row in range(options.rows)
        for i in halves
        if (i - row - options.rows - 1) % 2 == 0
    ]


def layout(options: Options) -> Layout:
    """The balls, the pegs from the top, the walls between bins from the left, then floor, right wall, ceiling, left."""
    largest, most = options.radius.support[1], int(options.balls.support[1])
    runs = (
        SlotGroup("circle", most),
        SlotGroup("circle", len(pegs(options)), STATIC),
        SlotGroup("segment", options.rows, STATIC),
        SlotGroup("segment", 4, STATIC),
    )
    top = top_peg(options) + options.spacing + (most - 1) * options.apart + 2 * largest
    return Layout(runs, (0.0, 0.0, width(options), top), largest)


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and start: balls at rest above the first peg, each a little aside."""
    here, (_, _, right, top) = layout(options), layout(options).bounds
    number = jnp.arange(len(factors["radius"]))
    heights = top_peg(options) + options.spacing + number * options.apart
    places = jnp.stack([right / 2 + factors["jitter"], heights], axis=-1)
    material = {name: factors[name] for name in ("density", "elasticity", "friction", "color")}
    balls = discs(places, factors["radius"], number < factors["balls"], **material)

    board = {"elasticity": factors["board_elasticity"], "friction": factors["board_friction"]}
    lattice = discs(jnp.asarray(pegs(options)), options.peg_radius, kind=STATIC, color=factors["peg_color"], **board)
    at = jnp.arange(1, options.rows + 1) * options.spacing
    feet = jnp.stack([at, jnp.zeros_like(at)], axis=-1)
    bins = segments(feet, feet + jnp.asarray([0.0, options.bin_height]), **board)
    parts = [balls, lattice, bins, box_walls(right, top, **board)]
    return SampledScene(*assemble(here, parts, factors["gravity"]))


FAMILY = Family(options=Options, layout=layout, sample=sample, check=check)
