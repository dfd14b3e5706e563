"""A pendulum of one link or two: rods with a bob at the end of each, which pass one another freely."""

import dataclasses
import math

import jax.numpy as jnp

from gen2d.plugin import (
    STATIC,
    Array,
    Distribution,
    Family,
    Field,
    JointSpec,
    Layout,
    SampledScene,
    SlotGroup,
    assemble,
    capsules_between,
    discs,
    distance_joints,
    option,
)

PIN = 0.08  # m, radius of the disc that the pendulum hangs from
ROD = 0.04  # m, radius of a rod


@dataclasses.dataclass(frozen=True)
class Options:
    """How many links, and what is drawn at random of each."""

    links: int = option(1, int, "links", "1: a pendulum, 2: a double pendulum", low=1, high=2)
    length: Distribution = option([1.0, 2.0], float, "m", "of each link", low=0.05, high=1000, draw=True, each="links")
    angle: Distribution = option(
        [-2.5, 2.5], float, "rad", "of each link at the start, from hanging down", draw=True, each="links"
    )
    swing: Distribution = option(0.0, float, "rad/s", "of each link at the start", draw=True, each="links")
    radius: Distribution = option([0.2, 0.35], float, "m", "of each bob", low=1e-3, high=100, draw=True, each="links")
    density: Distribution = option(1.0, float, "kg/m^2", "of each bob", low=1e-6, high=1e6, draw=True, each="links")
    rod_density: Distribution = option(0.2, float, "kg/m^2", "of the rods", low=1e-6, high=1e6, draw=True)
    gravity: tuple[Distribution, ...] = option([0, -9.8], float, "m/s^2", "x right, y up", parts=2, draw=True)
    color: tuple[Distribution, ...] = option(
        [[60, 254]] * 3, int, "sRGB", "of each bob", parts=3, draw=True, low=0, high=255, each="links"
    )


def sizes(options: Options) -> dict[str, int]:
    """How many links there are."""
    return {"links": options.links}


def layout(options: Options) -> Layout:
    """The pin, the rods and the bobs; each bob hangs on its rod from what is above it."""
    n, length, radius = options.links, options.length.support[1], options.radius.support[1]
    rods, bobs = SlotGroup("capsule", n, layer=1, collides=False), SlotGroup("circle", n, layer=2, collides=False)
    pin = SlotGroup("circle", 1, STATIC, layer=3, collides=False)
    # A bob turns with its rod, about what is above it; the rod, which is light, is fixed to it at both ends.
    ties = [
        (JointSpec("revolute", n + i if i else 0, 1 + n + i), *[JointSpec("revolute", 1 + i, 1 + n + i)] * 2)
        for i in range(n)
    ]
    room, widest = n * length + radius, max(map(abs, options.angle.support))
    low = n == 1 and options.swing.support == (0.0, 0.0) and widest < math.pi / 2
    bounds = (-room, -room, room, radius - math.cos(widest) * options.length.support[0] if low else room)
    joints = tuple(tie for link in ties for tie in link)
    return Layout((pin, rods, bobs), (*bounds[:3], max(bounds[3], PIN)), max(length / 2 + ROD, radius), joints)


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and start: every link at its angle."""
    length, angle, n = factors["length"], factors["angle"], options.links
    ways = length[:, None] * jnp.stack([jnp.sin(angle), -jnp.cos(angle)], -1)
    speeds = factors["swing"][:, None] * jnp.stack([-ways[:, 1], ways[:, 0]], -1)
    ends, end_speeds = jnp.cumsum(ways, 0), jnp.cumsum(speeds, 0)
    pin = discs(jnp.zeros((1, 2)), PIN, kind=STATIC, layer=3, collides=False)
    rods = capsules_between(
        ends - ways, ends, ROD, density=factors["rod_density"], velocity=end_speeds - speeds / 2, spin=factors["swing"],
        layer=1, collides=False,
    )  # fmt: skip
    bob = {name: factors[name] for name in ("density", "color")}
    bobs = discs(
        ends, factors["radius"], angle=angle, velocity=end_speeds, spin=factors["swing"], layer=2, collides=False, **bob
    )  # fmt: skip
    half, up = (jnp.stack(pair, -1) for pair in ((rods.objects["half_length"], jnp.zeros(n)), (jnp.zeros(n), length)))
    nothing = jnp.zeros((n, 2))
    # In the frame of a bob `up` is where it hangs; a rod goes from its left end to its right.
    above, below = (jnp.stack(x, 1).reshape(-1, 2) for x in ((nothing, -half, half), (up, up, nothing)))
    scene, state = assemble(layout(options), [pin, rods, bobs], factors["gravity"], distance_joints(above, below))
    return SampledScene(
        scene, state, derived={"period": _period(rods.objects, bobs.objects, length, factors["gravity"])}
    )


def _period(rods: dict[str, Array], bobs: dict[str, Array], length: Array, gravity: Array) -> Array:
    """Seconds of a small swing of the first link: 2 pi sqrt(I / m g d)."""
    rod, bob = rods["mass"][0], bobs["mass"][0]
    inertia = rods["moment"][0] + bobs["moment"][0] + (rod / 4 + bob) * length[0] ** 2
    return 2 * jnp.pi * jnp.sqrt(inertia / ((rod / 2 + bob) * length[0] * jnp.maximum(jnp.linalg.norm(gravity), 1e-6)))


FAMILY = Family(
    options=Options,
    layout=layout,
    sample=sample,
    sizes=sizes,
    derived={"period": Field("float32", "n", "s", "of small swings of the first link alone")},
)
