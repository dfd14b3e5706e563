"""A pendulum of one link or two: rods with a bob at the end of each, which do not collide."""

import dataclasses

import jax.numpy as jnp
import numpy as np

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
    builder,
    common,
    maximum,
    option,
)

PIN = 0.08  # m, radius of the disc that the pendulum hangs from
ROD = 0.04  # m, radius of a rod


@dataclasses.dataclass(frozen=True)
class Options:
    """The links of the pendulum, each a rod with a bob."""

    links: int = option(1, int, "links", "number of links; 1: a pendulum, 2: a double pendulum", low=1, high=2)
    length: Distribution = common.length("length of each link", [1.0, 2.0], each="links", low=0.05, high=1000)
    angle: Distribution = common.angle("angle of each link at the start, from hanging down", [-2.5, 2.5], each="links")
    spin: Distribution = common.spin("each link at the start", each="links")
    radius: Distribution = common.radius("each bob", [0.2, 0.35], each="links", high=100)
    density: Distribution = common.density("each bob", each="links")
    rod_radius: float | None = option(
        None, float, "m", f"radius of a rod; null: {ROD}", above=0, high=10, optional=True, later=True
    )
    rod_density: Distribution = common.density("the rods", 0.2)
    gravity: tuple[Distribution, ...] = common.gravity()
    color: tuple[Distribution, ...] = common.color("each bob", [[60, 254]] * 3, each="links")


def sizes(options: Options) -> dict[str, int]:
    """The number of links."""
    return {"links": options.links}


def layout(options: Options) -> Layout:
    """The pin, the rods and the bobs; each bob hangs from the pin or the bob above it."""
    n, length, radius = options.links, options.length.support[1], options.radius.support[1]
    rods, bobs = SlotGroup("capsule", n, layer=1, collides=False), SlotGroup("circle", n, layer=2, collides=False)
    pin = SlotGroup("circle", 1, STATIC, layer=3, collides=False)
    # A bob turns about the pin or the bob above it; its light rod is fixed to it at both ends.
    ends: list[tuple[int, int]] = []
    for i in range(n):
        rod, bob = 1 + i, 1 + n + i
        ends += [(bob - 1 if i else 0, bob), (rod, bob), (rod, bob)]
    joints = [JointSpec("revolute", *of, limited=False) for of in ends]
    room, widest = n * length + radius, maximum(*map(abs, options.angle.support))
    low = n == 1 and options.spin.support == (0.0, 0.0) and widest < np.pi / 2
    top = maximum(radius - np.cos(widest) * options.length.support[0] if low else room, PIN)
    return Layout(
        (pin, rods, bobs),
        (-room, -room, room, top),
        maximum(length / 2 + (options.rod_radius or ROD), radius),
        tuple(joints),
    )


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and initial state: every link at its angle."""
    length, angle, n = factors["length"], factors["angle"], options.links
    links = length[:, None] * jnp.stack([jnp.sin(angle), -jnp.cos(angle)], -1)
    speeds = factors["spin"][:, None] * jnp.stack([-links[:, 1], links[:, 0]], -1)
    ends, end_speeds = jnp.cumsum(links, 0), jnp.cumsum(speeds, 0)
    pin = builder.discs(jnp.zeros((1, 2)), PIN, kind=STATIC, layer=3, collides=False)
    rods = builder.capsules_between(
        ends - links, ends, options.rod_radius or ROD, velocity=end_speeds - speeds / 2, spin=factors["spin"],
        layer=1, collides=False,
        **builder.material(factors, "rod"),
    )  # fmt: skip
    bobs = builder.discs(
        ends, factors["radius"], angle=angle, velocity=end_speeds, spin=factors["spin"], layer=2, collides=False,
        **builder.material(factors),
    )  # fmt: skip
    half, up = (jnp.stack(pair, -1) for pair in ((rods.objects["half_length"], jnp.zeros(n)), (jnp.zeros(n), length)))
    zeros = jnp.zeros((n, 2))
    # `up` is the upper joint in the frame of a bob; a rod extends from its left end to its right end.
    above, below = (jnp.stack(x, 1).reshape(-1, 2) for x in ((zeros, -half, half), (up, up, zeros)))
    scene, state = builder.assemble(
        layout(options), [pin, rods, bobs], factors["gravity"], builder.distance_joints(above, below)
    )
    return SampledScene(
        scene, state, derived={"period": _period(rods.objects, bobs.objects, length, factors["gravity"])}
    )


def _period(rods: dict[str, Array], bobs: dict[str, Array], length: Array, gravity: Array) -> Array:
    """Period in s of small swings of the first link: 2 pi sqrt(I / m g d)."""
    rod, bob = rods["mass"][0], bobs["mass"][0]
    inertia = rods["moment"][0] + bobs["moment"][0] + (rod / 4 + bob) * length[0] ** 2
    return 2 * jnp.pi * jnp.sqrt(inertia / ((rod / 2 + bob) * length[0] * jnp.maximum(jnp.linalg.norm(gravity), 1e-6)))


FAMILY = Family(
    options=Options,
    layout=layout,
    sample=sample,
    sizes=sizes,
    derived={"period": Field("float32", "n", "s", "period of small oscillations of the first link alone")},
)
