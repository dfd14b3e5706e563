"""Balls in a closed box, with or without gravity."""

import dataclasses

import jax
import jax.numpy as jnp

from gen2d.config import option
from gen2d.factors import Distribution
from gen2d.placement import place
from gen2d.shapes import disc_mass, disc_moment
from gen2d.types import DYNAMIC, SHAPES, STATIC, Array, Layout, Objects, Run, Scene, State


@dataclasses.dataclass(frozen=True)
class Options:
    """What is drawn at random, and the box."""

    balls: Distribution = option([3, 8], int, "balls", "in a video", low=1, high=64, draw=True)
    width: float = option(10.0, float, "m", "of the box, inside", above=0, high=1000)
    height: float = option(10.0, float, "m", "of the box, inside", above=0, high=1000)
    radius: Distribution = option([0.5, 1.0], float, "m", "of each ball", low=1e-3, draw=True)
    density: Distribution = option(1.0, float, "kg/m^2", "of each ball", low=1e-6, high=1e6, draw=True)
    velocity: tuple[Distribution, ...] = option(
        [{"normal": [0, 3]}, {"normal": [0, 3]}], float, "m/s", "of each ball at the start", parts=2, draw=True
    )
    spin: Distribution = option(0.0, float, "rad/s", "of each ball at the start", draw=True)
    elasticity: Distribution = option(0.9, float, "1", "of each ball", low=0, high=1, draw=True)
    friction: Distribution = option(0.2, float, "1", "of each ball", low=0, high=100, draw=True)
    wall_elasticity: Distribution = option(0.9, float, "1", "of the box", low=0, high=1, draw=True)
    wall_friction: Distribution = option(0.2, float, "1", "of the box", low=0, high=100, draw=True)
    gravity: tuple[Distribution, ...] = option(
        [0, -9.8], float, "m/s^2", "x right, y up; the same for a whole video", parts=2, draw=True
    )
    color: tuple[Distribution, ...] = option(
        [[40, 254]] * 3, int, "sRGB", "of each ball", parts=3, draw=True, low=0, high=255
    )


# Axes of the factors: one number a video, or one for each of N balls.
FACTORS = {
    "balls": "n",
    "radius": "n N",
    "density": "n N",
    "velocity": "n N",
    "spin": "n N",
    "elasticity": "n N",
    "friction": "n N",
    "wall_elasticity": "n",
    "wall_friction": "n",
    "gravity": "n",
    "color": "n N",
}


def check(options: Options) -> None:
    """ValueError where the box cannot hold a ball."""
    largest = options.radius.support[1]
    if not 2 * largest < min(options.width, options.height):
        raise ValueError(
            f"radius may be {largest:g} m, but a ball must fit a box of {options.width:g} x {options.height:g} m"
        )


def sizes(options: Options) -> dict[str, int]:
    """The sizes of the factors' axes."""
    return {"N": int(options.balls.support[1])}


def layout(options: Options) -> Layout:
    """N balls, then floor, right wall, ceiling, left wall."""
    bounds = (0.0, 0.0, options.width, options.height)
    runs = Run("circle", sizes(options)["N"]), Run("segment", 4, STATIC)
    return Layout(runs, bounds, options.radius.support[1])


def sample(key: Array, factors: dict[str, Array], options: Options) -> tuple[Scene, State, Array, Array]:
    """One video's scene and initial state, how many places were drawn again, and whether every ball found one."""
    balls = sizes(options)["N"]
    present = jnp.arange(balls) < factors["balls"]
    box = jnp.asarray([options.width, options.height])
    places, rejected, placed = place(jax.random.fold_in(key, 0), factors["radius"], present, jnp.zeros(2), box)
    velocity = jnp.where(present[:, None], factors["velocity"], 0.0)
    spin = jnp.where(present, factors["spin"], 0.0)
    middle, turn = jnp.asarray([[0.5, 0.0], [1.0, 0.5], [0.5, 1.0], [0.0, 0.5]]), jnp.asarray([0.0, 0.5, 1.0, 1.5])
    state = State(
        position=jnp.concatenate([places, middle * box]),
        angle=jnp.concatenate([jnp.zeros(balls), turn * jnp.pi]),
        velocity=jnp.concatenate([velocity, jnp.zeros((4, 2))]),
        angular_velocity=jnp.concatenate([spin, jnp.zeros(4)]),
    )
    return Scene(_objects(factors, present, options), factors["gravity"]), state, rejected, placed


def _objects(factors: dict[str, Array], present: Array, options: Options) -> Objects:
    balls, walls = present.shape[0], jnp.ones(4)

    def both(of_balls: Array, of_walls: Array, dtype: type = jnp.float32) -> Array:
        mask = present if of_balls.ndim == 1 else present[:, None]
        return jnp.concatenate([jnp.where(mask, of_balls, 0), of_walls]).astype(dtype)

    depths = jnp.asarray(layout(options).depths)
    mass = disc_mass(factors["radius"], factors["density"])
    length = jnp.asarray([options.width, options.height, options.width, options.height])
    return Objects(
        present=both(present, walls, jnp.bool_),
        kind=both(jnp.full(balls, DYNAMIC), STATIC * walls, jnp.uint8),
        shape=both(jnp.zeros(balls), SHAPES.index("segment") * walls, jnp.uint8),
        radius=both(factors["radius"], 0 * walls),
        half_length=both(jnp.zeros(balls), length / 2),
        depth=both(depths[:balls], depths[balls:], jnp.int16),
        mass=both(mass, jnp.inf * walls),
        moment=both(disc_moment(factors["radius"], mass), jnp.inf * walls),
        elasticity=both(factors["elasticity"], factors["wall_elasticity"] * walls),
        friction=both(factors["friction"], factors["wall_friction"] * walls),
        color=both(factors["color"], jnp.full((4, 3), 128), jnp.uint8),
    )
