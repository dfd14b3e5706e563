"""A plank on a pivot, with weights that lie on it or fall on it."""

import dataclasses

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
    boxes,
    distance_joints,
    option,
    polygons,
    segments,
)

FAR = 4.0  # the floor's length, over the view's width


@dataclasses.dataclass(frozen=True)
class Options:
    """What is drawn at random."""

    weights: Distribution = option([1, 4], int, "weights", "in a video", low=1, high=32, draw=True)
    length: Distribution = option([6.0, 8.0], float, "m", "of the plank", low=0.1, high=1000, draw=True)
    thickness: Distribution = option([0.2, 0.3], float, "m", "of the plank", low=1e-2, high=100, draw=True)
    plank_density: Distribution = option(0.5, float, "kg/m^2", "of the plank", low=1e-6, high=1e6, draw=True)
    pivot: Distribution = option([0.8, 1.4], float, "m", "height of the plank's middle", low=0.02, high=100, draw=True)
    width: Distribution = option([0.6, 1.2], float, "m", "of each weight", low=1e-2, draw=True, each="weights")
    height: Distribution = option([0.6, 1.2], float, "m", "of each weight", low=1e-2, draw=True, each="weights")
    place: Distribution = option(
        [0.0, 1.0], float, "1", "of each weight in its own one of as many equal parts of the plank; 0: leftmost",
        low=0, high=1, draw=True, each="weights",
    )  # fmt: skip
    drop: Distribution = option(
        [0.0, 1.5], float, "m", "of each weight, above the plank", low=0, draw=True, each="weights"
    )
    density: Distribution = option(
        {"log_uniform": [0.5, 2.0]}, float, "kg/m^2", "of each weight", low=1e-6, high=1e6, draw=True, each="weights"
    )
    elasticity: Distribution = option(0.0, float, "1", "of all but the floor", low=0, high=1, draw=True)
    friction: Distribution = option([0.5, 0.9], float, "1", "of all", low=0, high=100, draw=True)
    gravity: tuple[Distribution, ...] = option([0, -9.8], float, "m/s^2", "x right, y up", parts=2, draw=True)
    plank_color: tuple[Distribution, ...] = option(
        [150, 110, 70], int, "sRGB", "of the plank", parts=3, draw=True, low=0, high=255
    )
    color: tuple[Distribution, ...] = option(
        [[60, 254]] * 3, int, "sRGB", "of each weight", parts=3, draw=True, low=0, high=255, each="weights"
    )


def check(options: Options) -> None:
    """ValueError where a weight may be wider than its part of the plank, or the plank may touch the floor."""
    part = options.length.support[0] / options.weights.support[1]
    if options.width.support[1] > part:
        raise ValueError(
            f"width may be {options.width.support[1]:g} m, but a weight must fit its part of the plank, which may be "
            f"{part:g} m (length over weights)"
        )
    if options.thickness.support[1] >= 2 * options.pivot.support[0]:
        raise ValueError(
            f"thickness may be {options.thickness.support[1]:g} m, but the plank must be above the floor, with its "
            f"middle at {options.pivot.support[0]:g} m (pivot)"
        )


def layout(options: Options) -> Layout:
    """The floor, the stand, the plank, then the weights from left to right."""
    most = int(options.weights.support[1])
    length, width, height = (getattr(options, name).support[1] for name in ("length", "width", "height"))
    runs = (
        SlotGroup("segment", 1, STATIC),
        SlotGroup("polygon", 1, STATIC, vertices=3),
        SlotGroup("polygon", 1, vertices=4, layer=1),
        SlotGroup("polygon", most, vertices=4, layer=1),
    )
    top = options.pivot.support[1] + options.thickness.support[1] / 2 + options.drop.support[1] + height
    half = length / 2 + max(width, height)  # what slides off lies beside it
    reach = max(length**2 + options.thickness.support[1] ** 2, width**2 + height**2) ** 0.5 / 2
    return Layout(runs, (-half, 0.0, half, max(top, length / 2)), reach, (JointSpec("revolute", 1, 2),))


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and start: the plank level, its weights on it or above it."""
    layers, pivot, length, thickness = layout(options), factors["pivot"], factors["length"], factors["thickness"]
    solid = {name: factors[name] for name in ("elasticity", "friction")}
    wide = FAR * layers.bounds[2]
    floor = segments([(-wide, 0.0)], [(wide, 0.0)], friction=factors["friction"])
    # Its upper corner is the pivot, its centre of mass at a third of the height.
    corners = pivot * jnp.asarray([[-0.4, -1 / 3], [0.4, -1 / 3], [0.0, 2 / 3]])
    stand = polygons(jnp.stack([jnp.zeros(()), pivot / 3])[None], 0.0, corners[None], kind=STATIC, **solid)
    level = jnp.stack([jnp.zeros(()), pivot])[None]
    plank = boxes(
        level, 0.0, length, thickness, density=factors["plank_density"], color=factors["plank_color"], layer=1, **solid
    )
    numbers, part = jnp.arange(len(factors["width"])), length / factors["weights"]
    x = numbers * part + factors["width"] / 2 + factors["place"] * (part - factors["width"]) - length / 2
    y = pivot + (thickness + factors["height"]) / 2 + factors["drop"]
    weights = boxes(
        jnp.stack([x, y], -1), 0.0, factors["width"], factors["height"], numbers < factors["weights"],
        density=factors["density"], color=factors["color"], layer=1, **solid,
    )  # fmt: skip
    nowhere = jnp.zeros((1, 2))
    joint = distance_joints(jnp.asarray([[0.0, 2 / 3]]) * pivot, nowhere)
    scene, state = assemble(layers, [floor, stand, plank, weights], factors["gravity"], joint)
    torque = factors["gravity"][1] * jnp.sum(weights.objects["mass"] * x)
    return SampledScene(scene, state, derived={"torque": torque})


FAMILY = Family(
    options=Options,
    layout=layout,
    sample=sample,
    check=check,
    derived={"torque": Field("float32", "n", "N m", "of all weights about the pivot while the plank is level")},
)
