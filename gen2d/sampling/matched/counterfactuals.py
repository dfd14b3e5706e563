"""Counterfactual members: another factor."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from gen2d.config.matched import INTERVENTIONS
from gen2d.config.options import drawn_options
from gen2d.records.axes import Array
from gen2d.records.keys import key_for
from gen2d.records.scene import Objects, State
from gen2d.sampling.matched.sets import SetMember, along_slots

# ---- Counterfactuals: other factors


def changed_factors(member: SetMember, config: Any, found: dict[str, Array], draw: Callable) -> dict[str, Array]:
    """The factors, with the one that the set is about drawn anew or scaled; `draw(key)` draws all."""
    specs, matched, again, made = (
        drawn_options(config.scene.contract),
        config.matched,
        draw(member.own_key),
        dict(found),
    )
    for place, name in enumerate(matched.change):
        if name in INTERVENTIONS:
            continue
        spec, new = specs[name], again[name]
        if matched.scale is not None:
            scale = matched.scale.sample(key_for(member.own_key, "scale"), ())
            new = jnp.clip(found[name] * scale, spec.low, spec.high)
        if spec.each and matched.objects == "one":
            count = jnp.maximum(found.get(spec.each, len(new)), 1)
            one = jax.random.randint(key_for(member.set_key, "one"), (), 0, count)
            new = jnp.where(along_slots(jnp.arange(len(new)) == one, new), new, found[name])
        made[name] = jnp.where(member.changed & (member.kind == place), new, found[name])
    return made


def changed_slot(one: tuple[Objects, State], other: tuple[Objects, State]) -> Array:
    """The only slot that holds something else in two scenes at their start; -1 where there are none or several."""
    differ = jnp.zeros(one[0].present.shape, bool)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        differ |= (a != b).reshape(len(differ), -1).any(axis=1)
    return jnp.where(differ.sum() == 1, jnp.argmax(differ), -1)
