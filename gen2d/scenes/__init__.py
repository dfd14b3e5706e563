"""Scene families, one file each, named like the family; a config selects one by `scene: NAME` or `scene: my/NAME.py`.

A file ends with a `FAMILY`, whose members `gen2d.plugin.Family` describes. The smallest one:

    import dataclasses
    import jax.numpy as jnp
    from gen2d.plugin import Family, Layout, SampledScene, SlotGroup, builder, option

    @dataclasses.dataclass(frozen=True)
    class Options:
        radius: object = option([0.2, 0.4], float, "m", "of the disc", above=0, high=0.5, draw=True)

    def layout(options):
        return Layout((SlotGroup("circle", 1),), bounds=(0, 0, 1, 1), reach=options.radius.support[1])

    def sample(key, factors, options):
        disc = builder.discs(jnp.array([[0.5, 0.5]]), factors["radius"][None], True)
        return SampledScene(*builder.assemble(layout(options), [disc], gravity=jnp.zeros(2)))

    FAMILY = Family(options=Options, layout=layout, sample=sample)

The groups of `layout` and of `builder.assemble` are the same, in the same order, and slots count their objects from 0.
A joint names two slots in the layout; `builder.distance_joints` makes the numbers of all joints. Here the disc hangs
from a pin by a spring, whose rest length is the distance at the start:

    groups = SlotGroup("circle", 1, STATIC, collides=False), SlotGroup("circle", 1)
    Layout(groups, bounds=(0, -3, 1, 1), reach=0.5, joints=(JointSpec("distance", 0, 1),))

    pin = builder.discs(jnp.array([[0.5, 0.9]]), 0.05, kind=STATIC, collides=False)
    spring = builder.distance_joints([[0, 0]], [[0, 0]], stiffness=factors["stiffness"])  # anchors, m; N/m
    builder.assemble(layout(options), [pin, disc], jnp.array([0, -9.8]), spring)

A group has one shape and one kind of body, static or dynamic. `pendulum.py` and `chain.py` have revolute joints.
"""
