"""Balls dropped through a lattice of pegs into bins: Galton's board."""

import dataclasses
import math

import jax.numpy as jnp

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
    option,
)


@dataclasses.dataclass(frozen=True)
class Options:
    """The balls and the board."""

    balls: Distribution = common.count("balls", [1, 3], "number of balls, one above the other")
    rows: int = option(5, int, "rows", "number of rows of pegs; there is one bin more", low=1, high=12)
    spacing: float = option(1.0, float, "m", "distance of neighbouring pegs, in and between rows", above=0, high=100)
    peg_radius: float = option(0.18, float, "m", "radius of each peg", above=0)
    bin_height: float = common.size("height of the bins", 1.8)
    ball_spacing: float = option(
        0.9, float, "m", "distance from one ball's centre to the next one's at the start", above=0
    )
    radius: Distribution = common.radius("each ball", [0.2, 0.26], each="balls")
    jitter: Distribution = common.length("offset of each ball from the middle", [-0.15, 0.15], each="balls", low=None)
    density: Distribution = common.density("each ball", each="balls")
    elasticity: Distribution = common.elasticity("each ball", [0.5, 0.9], each="balls")
    friction: Distribution = common.friction("each ball", 0.2, each="balls")
    board_elasticity: Distribution = common.elasticity("pegs and bins", [0.5, 0.8])
    board_friction: Distribution = common.friction("pegs and bins", 0.2)
    gravity: tuple[Distribution, ...] = common.gravity()
    color: tuple[Distribution, ...] = common.color("each ball", each="balls")
    peg_color: tuple[Distribution, ...] = common.color("pegs", [150] * 3)


def check(options: Options) -> None:
    """Raise ValueError if a ball does not fit between pegs, or two touch at the start."""
    largest, room = options.radius.support[1], options.spacing - 2 * options.peg_radius
    if not 2 * largest < room:
        raise ValueError(f"radius may be {largest:g} m, but a ball must fit between pegs {room:g} m apart")
    if not 2 * largest < options.ball_spacing:
        raise ValueError(
            f"ball_spacing is {options.ball_spacing:g} m, but must be above the diameter of a ball, {2 * largest:g} m"
        )
    aside = max(map(abs, options.jitter.support))
    if not aside + largest < width(options) / 2:
        raise ValueError(f"jitter may be {aside:g} m to a side, but a ball must fit a board of {width(options):g} m")


def width(options: Options) -> float:
    """Width of the board, m."""
    return (options.rows + 1) * options.spacing


def top_peg(options: Options) -> float:
    """Height of the first row of pegs, m; the last row is half a spacing above the bins."""
    return options.bin_height + options.spacing * (0.5 + math.sqrt(0.75) * (options.rows - 1))


def pegs(options: Options) -> list[tuple[float, float]]:
    """Centres of the pegs, m, in rows from the top; the last row stands above the walls between bins.

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
    groups = (
        SlotGroup("circle", most),
        SlotGroup("circle", len(pegs(options)), STATIC),
        SlotGroup("segment", options.rows, STATIC),
        SlotGroup("segment", 4, STATIC),
    )
    top = top_peg(options) + options.spacing + (most - 1) * options.ball_spacing + 2 * largest
    return Layout(groups, (0.0, 0.0, width(options), top), largest)


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and initial state: balls at rest above the first peg, slightly off centre."""
    scene_layout = layout(options)
    _, _, right, top = scene_layout.bounds
    number = jnp.arange(len(factors["radius"]))
    heights = top_peg(options) + options.spacing + number * options.ball_spacing
    positions = jnp.stack([right / 2 + factors["jitter"], heights], axis=-1)
    balls = builder.discs(positions, factors["radius"], number < factors["balls"], **builder.material(factors))

    board = builder.material(factors, "board")
    lattice = builder.discs(
        jnp.asarray(pegs(options)), options.peg_radius, kind=STATIC, color=factors["peg_color"], **board
    )
    x = jnp.arange(1, options.rows + 1) * options.spacing
    feet = jnp.stack([x, jnp.zeros_like(x)], axis=-1)
    bins = builder.segments(feet, feet + jnp.asarray([0.0, options.bin_height]), **board)
    parts = [balls, lattice, bins, builder.box_walls(right, top, **board)]
    return SampledScene(*builder.assemble(scene_layout, parts, factors["gravity"]))


FAMILY = Family(
    options=Options,
    layout=layout,
    sample=sample,
    check=check,
    bodies={"balls": Bodies("circle", ("radius",), bears=("balls",))},
)
