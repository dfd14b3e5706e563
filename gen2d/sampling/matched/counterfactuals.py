"""Counterfactual members: one factor has another value."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from gen2d.config.matched import INTERVENTIONS
from gen2d.config.options import factor_options
from gen2d.records.axes import Array
from gen2d.records.keys import key_for
from gen2d.records.scene import Objects, State
from gen2d.sampling.matched.sets import SetMember, along_slots


def change_factors(member: SetMember, config: Any, factors: dict[str, Array], draw: Callable) -> dict[str, Array]:
    """Factors, with the one that the set changes scaled or sampled again; `draw(key)` samples all factors."""
    specs, matched = factor_options(config.scene.contract), config.matched
    samples, changed = draw(member.own_key), dict(factors)
    for index, name in enumerate(matched.change):
        if name in INTERVENTIONS:
            continue
        spec, new = specs[name], samples[name]
        if matched.scale is not None:
            scale = matched.scale.sample(key_for(member.own_key, "scale"), ())
            new = jnp.clip(factors[name] * scale, spec.low, spec.high)
        if spec.each and matched.objects == "one":
            count = jnp.maximum(factors.get(spec.each, len(new)), 1)
            one = jax.random.randint(key_for(member.set_key, "one"), (), 0, count)
            new = jnp.where(along_slots(jnp.arange(len(new)) == one, new), new, factors[name])
        changed[name] = jnp.where(member.changed & (member.kind == index), new, factors[name])
    return changed


def changed_slot(one: tuple[Objects, State], other: tuple[Objects, State]) -> Array:
    """The only slot in which two initial states differ; -1 if none or several do."""
    differ = jnp.zeros(one[0].present.shape, bool)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        differ |= (a != b).reshape(len(differ), -1).any(axis=1)
    return jnp.where(differ.sum() == 1, jnp.argmax(differ), -1)
