"""A plank on a pivot, with weights that lie on it or fall on it."""

import dataclasses

import jax.numpy as jnp

from gen2d.plugin import (
    STATIC,
    Array,
    Bodies,
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
)


@dataclasses.dataclass(frozen=True)
class Options:
    """The plank and its weights."""

    weights: Distribution = common.count("weights", [1, 4], high=32)
    length: Distribution = common.length("length of the plank", [6.0, 8.0], low=0.1, high=1000)
    thickness: Distribution = common.length("thickness of the plank", [0.2, 0.3], low=1e-2, high=100)
    plank_density: Distribution = common.density("the plank", 0.5)
    pivot_height: Distribution = common.length("height of the pivot", [0.8, 1.4], low=0.02, high=100)
    width: Distribution = common.length("width of each weight", [0.6, 1.2], each="weights", low=1e-2)
    height: Distribution = common.length("height of each weight", [0.6, 1.2], each="weights", low=1e-2)
    relative_position: Distribution = common.fraction("position in its part of the plank; 0: leftmost", each="weights")
    drop_height: Distribution = common.length("height of each weight above the plank", [0.0, 1.5], each="weights")
    density: Distribution = common.density("each weight", {"log_uniform": [0.5, 2.0]}, each="weights")
    elasticity: Distribution = common.elasticity("all but the floor", 0.0)
    friction: Distribution = common.friction("all", [0.5, 0.9])
    gravity: tuple[Distribution, ...] = common.gravity()
    plank_color: tuple[Distribution, ...] = common.color("the plank", [150, 110, 70])
    color: tuple[Distribution, ...] = common.color("each weight", [[60, 254]] * 3, each="weights")


def check(options: Options) -> None:
    """Raise ValueError if a weight may be wider than its part of the plank, or the plank may touch the floor."""
    part = options.length.support[0] / options.weights.support[1]
    if options.width.support[1] > part:
        raise ValueError(
            f"width may be {options.width.support[1]:g} m, but a weight must fit its part of the plank, which may be "
            f"{part:g} m (length over weights)"
        )
    if options.thickness.support[1] >= 2 * options.pivot_height.support[0]:
        raise ValueError(
            f"thickness may be {options.thickness.support[1]:g} m, but the plank must be above the floor, with its "
            f"middle at {options.pivot_height.support[0]:g} m (pivot_height)"
        )


def layout(options: Options) -> Layout:
    """The floor, the stand, the plank, then the weights from left to right."""
    most = int(options.weights.support[1])
    length, width, height = (getattr(options, name).support[1] for name in ("length", "width", "height"))
    groups = (
        SlotGroup("segment", 1, STATIC),
        SlotGroup("polygon", 1, STATIC, vertices=3),
        SlotGroup("polygon", 1, vertices=4, layer=1),
        SlotGroup("polygon", most, vertices=4, layer=1),
    )
    top = options.pivot_height.support[1] + options.thickness.support[1] / 2 + options.drop_height.support[1] + height
    half = length / 2 + maximum(width, height)  # room for weights that slide off
    reach = maximum(length**2 + options.thickness.support[1] ** 2, width**2 + height**2) ** 0.5 / 2
    joint = JointSpec("revolute", 1, 2, limited=False)
    return Layout(groups, (-half, 0.0, half, maximum(top, length / 2)), reach, (joint,))


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and initial state: the plank level, its weights on it or above it."""
    scene_layout = layout(options)
    pivot, length, thickness = (factors[name] for name in ("pivot_height", "length", "thickness"))
    surface = {name: factors[name] for name in ("elasticity", "friction")}
    ground = builder.floor(scene_layout, friction=factors["friction"])
    # The upper corner is the pivot, and the centre of mass lies at a third of the height.
    corners = pivot * jnp.asarray([[-0.4, -1 / 3], [0.4, -1 / 3], [0.0, 2 / 3]])
    stand = builder.polygons(jnp.stack([jnp.zeros(()), pivot / 3])[None], 0.0, corners[None], kind=STATIC, **surface)
    plank = builder.boxes(
        jnp.stack([jnp.zeros(()), pivot])[None], 0.0, length, thickness,
        layer=1, **surface, **builder.material(factors, "plank"),
    )  # fmt: skip
    numbers, part = jnp.arange(len(factors["width"])), length / factors["weights"]
    x = numbers * part + factors["width"] / 2 + factors["relative_position"] * (part - factors["width"]) - length / 2
    y = pivot + (thickness + factors["height"]) / 2 + factors["drop_height"]
    weights = builder.boxes(
        jnp.stack([x, y], -1), 0.0, factors["width"], factors["height"], numbers < factors["weights"],
        layer=1, **builder.material(factors),
    )  # fmt: skip
    centre = jnp.zeros((1, 2))
    joint = builder.distance_joints(jnp.asarray([[0.0, 2 / 3]]) * pivot, centre)
    scene, state = builder.assemble(scene_layout, [ground, stand, plank, weights], factors["gravity"], joint)
    torque = factors["gravity"][1] * jnp.sum(weights.objects["mass"] * x)
    return SampledScene(scene, state, derived={"torque": torque})


FAMILY = Family(
    options=Options,
    layout=layout,
    sample=sample,
    check=check,
    bodies={
        "plank": Bodies("box", ("length", "thickness"), "plank_density", bears=("weights",)),
        "weights": Bodies("box", ("width", "height")),
    },
    derived={"torque": Field("float32", "n", "N m", "torque of all weights about the pivot while the plank is level")},
)
