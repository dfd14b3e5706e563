"""From a video's key to its scene: the factors that a family's options name are drawn, and the family builds from them.

A factor is an option that is drawn: one number a video, or one for each of the things that its `each` names. That is a
drawn whole number such as `balls`, whose largest value is the length of the axis, or a size that the family fixes.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from gen2d import factors
from gen2d.config import Plugin
from gen2d.factors import options_of
from gen2d.fields import Field
from gen2d.parts import Sampled
from gen2d.types import Array


def sizes(scene: Plugin) -> dict[str, int]:
    """The lengths of the factors' axes: the most there may be of what is counted, and those that the family fixes."""
    fixed = scene.module.sizes(scene.options) if hasattr(scene.module, "sizes") else {}
    counted = {spec.each for spec in options_of(scene.module).values() if spec.each} - fixed.keys()
    return fixed | {each: int(getattr(scene.options, each).support[1]) for each in sorted(counted)}


def fields(scene: Plugin) -> dict[str, Field]:
    """What is stored of the factors, and of the numbers that the family derives from them."""
    found = {}
    for name, spec in options_of(scene.module).items():
        axes = " ".join(["n", *([spec.each] if spec.each else []), *([str(spec.parts)] if spec.parts else [])])
        found[f"factors/{name}"] = Field("float32", axes, spec.unit or "1", f"as drawn: {spec.meaning}")
    derived = getattr(scene.module, "DERIVED", {})
    return found | {f"factors/{name}": field for name, field in derived.items()}


def drawn(key: Array, scene: Plugin, change: Callable | None = None) -> dict[str, Array]:
    """A video's factors by name; zero for what is beyond the number there is. `change(found, draw)` makes others of
    those that are found; `draw(key)` draws all anew."""
    lengths = sizes(scene)
    wanted = {
        name: (getattr(scene.options, name), (lengths[spec.each],) if spec.each else ())
        for name, spec in options_of(scene.module).items()
    }
    found = factors.draw(key, wanted)
    found = found if change is None else change(found, lambda other: factors.draw(other, wanted))
    return {name: _counted(values, name, found, scene) for name, values in found.items()}


def _counted(values: Array, name: str, found: dict[str, Array], scene: Plugin) -> Array:
    each = options_of(scene.module)[name].each
    if each not in found:
        return values
    there = jnp.arange(values.shape[0]) < found[each]
    return jnp.where(there.reshape(-1, *[1] * (values.ndim - 1)), values, 0)


def sampled(key: Array, scene: Plugin, change: Callable | None = None) -> tuple[dict[str, Array], Sampled]:
    """A video's factors, those that follow from others included, and its scene and start."""
    draw_key, place_key = jax.random.split(key)
    found = drawn(draw_key, scene, change)
    made: Any = scene.module.sample(place_key, found, scene.options)
    rejected, fits = jnp.asarray(made.rejected, jnp.int32), jnp.asarray(made.fits, bool)
    return {**found, **made.derived}, made._replace(rejected=rejected, fits=fits, derived={})
