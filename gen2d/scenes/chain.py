"""A chain that is pulled tight between two pins and released, or that swings from one pin.

Links collide neither with each other nor with the pins.
"""

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
    minimum,
    option,
)


@dataclasses.dataclass(frozen=True)
class Options:
    """The chain and the pins that it hangs from."""

    links: int = option(12, int, "links", "number of links in the chain", low=2, high=200)
    ends: int = option(2, int, "pins", "number of pins that the chain hangs from", low=1, high=2)
    length: Distribution = common.length("length of a link, joint to joint", [0.35, 0.5], low=1e-2, high=100)
    radius: Distribution = common.radius("a link", [0.06, 0.1], high=100)
    density: Distribution = common.density("the links")
    span: Distribution = common.fraction("distance between two pins, over the chain's length", [0.4, 0.85])
    slope: Distribution = common.angle("slope of the line from the left pin to the right one", [-0.3, 0.3])
    pulled_joint: Distribution = common.fraction("joint that is pulled; 0: the first that is possible, 1: the last")
    pulled_above: Distribution = option(
        [0, 1], int, "1", "direction of the pull; 1: up, 0: down", low=0, high=1, draw=True
    )
    angle: Distribution = common.angle("angle of a chain with one pin at the start, from hanging down", [-2.0, 2.0])
    friction: Distribution = option(0.0, float, "N m", "largest torque of the friction in a joint", low=0, draw=True)
    gravity: tuple[Distribution, ...] = common.gravity()
    color: tuple[Distribution, ...] = common.color("each link", [[60, 254]] * 3, each="links")


def sizes(options: Options) -> dict[str, int]:
    """The number of links."""
    return {"links": options.links}


def check(options: Options) -> None:
    """Raise ValueError if the chain may have no joint that can pull it tight."""
    least = options.span.support[0]
    if options.ends == 2 and not 2 / options.links <= least <= options.span.support[1] < 1:
        raise ValueError(
            f"span may be {least:g} to {options.span.support[1]:g}, but must be {2 / options.links:g} or more (2 over "
            "links), and below 1"
        )


def layout(options: Options) -> Layout:
    """The pins, then the links, each hung from the previous one."""
    n, pins, radius = options.links, options.ends, options.radius.support[1]
    ends = [(pins + i - 1 if i else 0, pins + i) for i in range(n)] + [(1, pins + n - 1)] * (pins == 2)
    joints = [JointSpec("revolute", *of, limited=options.friction.support[1] > 0) for of in ends]
    groups = SlotGroup("circle", pins, STATIC, layer=2, collides=False), SlotGroup("capsule", n, collides=False)
    length = options.length.support[1]
    return Layout(groups, _bounds(options, n * length), length / 2 + radius, tuple(joints))


def _bounds(options: Options, whole: float) -> tuple[float, float, float, float]:
    """Bounds in m of the region that a chain of this length can reach, without its rarely reached upper part."""
    rim = 2 * options.radius.support[1]
    if options.ends == 1:
        turn = minimum(maximum(*map(abs, options.angle.support)), np.pi)
        return -whole - rim, -whole - rim, whole + rim, maximum(-np.cos(turn), 0.2) * whole + rim
    # An ellipse with the pins as its foci.
    depth = whole / 2 * np.sqrt(1 - options.span.support[0] ** 2)
    tilt = whole / 2 * np.sin(minimum(maximum(*map(abs, options.slope.support)), np.pi / 2))
    top = depth if options.pulled_above.support[1] else 0.2 * depth
    return -whole / 2 - rim, -depth - tilt - rim, whole / 2 + rim, top + tilt + rim


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and initial state: the taut chain at rest."""
    n, radius = options.links, factors["radius"]
    corners, kink = _straight(factors, n) if options.ends == 1 else _pulled(factors, n)
    pins = builder.discs(
        corners[:: n if options.ends == 2 else n + 1], 1.5 * radius, kind=STATIC, layer=2, collides=False
    )
    material = {"density": factors["density"], "color": factors["color"], "collides": False}
    links = builder.capsules_between(corners[:-1], corners[1:], radius, **material)
    joints = builder.hinge_chain(links, options.ends == 2, motor_torque=factors["friction"])
    scene, state = builder.assemble(layout(options), [pins, links], factors["gravity"], joints)
    return SampledScene(scene, state, derived={"kink": kink})


def _straight(factors: dict[str, Array], n: int) -> tuple[Array, Array]:
    """Joints [n + 1, 2] in m of a straight chain from the pin at the origin, and the number of its kink, 0."""
    direction = jnp.stack([jnp.sin(factors["angle"]), -jnp.cos(factors["angle"])])
    return jnp.arange(n + 1.0)[:, None] * factors["length"] * direction, jnp.zeros(())


def _pulled(factors: dict[str, Array], n: int) -> tuple[Array, Array]:
    """Joints [n + 1, 2] in m of a chain along two sides of a triangle, and the number of the joint between the sides.

    The midpoint of the third side, from pin to pin, is the origin.
    """
    span = factors["span"] * n  # all in lengths of a link
    first, last = jnp.ceil((n - span) / 2 + 1e-3), jnp.floor((n + span) / 2 - 1e-3)
    kink = first + jnp.minimum(jnp.floor(factors["pulled_joint"] * (last - first + 1)), last - first)
    along = (kink**2 - (n - kink) ** 2 + span**2) / (2 * span)
    aside = jnp.sqrt(jnp.maximum(kink**2 - along**2, 0.0)) * (2 * factors["pulled_above"] - 1)
    number, zero = jnp.arange(n + 1.0), jnp.zeros(())
    left_pin, tip, right_pin = jnp.stack([zero, zero]), jnp.stack([along, aside]), jnp.stack([span, zero])
    up, down = (number / kink)[:, None], ((number - kink) / (n - kink))[:, None]
    corners = jnp.where(number[:, None] <= kink, left_pin + up * (tip - left_pin), tip + down * (right_pin - tip))
    corners = corners - jnp.stack([span / 2, zero])
    cos, sin = jnp.cos(factors["slope"]), jnp.sin(factors["slope"])
    return factors["length"] * corners @ jnp.stack([jnp.stack([cos, sin]), jnp.stack([-sin, cos])]), kink


FAMILY = Family(
    options=Options,
    layout=layout,
    sample=sample,
    check=check,
    sizes=sizes,
    derived={"kink": Field("float32", "n", "1", "joint that is pulled at the start, counted from the left pin")},
)
