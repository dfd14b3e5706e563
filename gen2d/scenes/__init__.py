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
"""
