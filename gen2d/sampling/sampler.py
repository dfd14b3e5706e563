"""From a video's key to its scene: the factors that a family's options name are drawn, and the family builds from them.

A factor is an option that is drawn: one number a video, or one for each of the things that its `each` names. That is a
drawn whole number such as `balls`, whose largest value is the length of the axis, or a size that the family fixes.

Each split has a law of its own (laws.py). One program draws from all of them: it is told the split's row.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.config.config import Config
from gen2d.config.distributions import Span
from gen2d.config.joint_distribution import JointDistribution
from gen2d.config.options import Option, coordinates, drawn_options
from gen2d.config.plugin_options import Plugin
from gen2d.core.permutation import hashed
from gen2d.core.schema import Field
from gen2d.loading.epochs import order
from gen2d.records.axes import Array
from gen2d.records.keys import key_for, keys_for
from gen2d.sampling.builder import SampledScene

SampledFactors = dict[str, Array]
FactorChange = Callable[[SampledFactors, Callable[[Array], SampledFactors]], SampledFactors]


def sizes(scene: Plugin) -> dict[str, int]:
    """The lengths of the factors' axes: the most there may be of what is counted, and those that the family fixes."""
    fixed = dict(scene.contract.sizes(scene.options))
    counted = {spec.each for spec in drawn_options(scene.contract).values() if spec.each} - fixed.keys()
    return fixed | {each: int(getattr(scene.options, each).support[1]) for each in sorted(counted)}


def fields(config: Config) -> dict[str, Field]:
    """What is stored of the factors, of the numbers that the family derives from them, and of splits."""
    found, splits = {}, {}
    for name, spec in drawn_options(config.scene.contract).items():
        axes = " ".join(["n", *([spec.each] if spec.each else []), *([str(spec.parts)] if spec.parts else [])])
        unit = spec.unit or "1"
        found[f"factors/{name}"] = Field("float32", axes, unit, f"as drawn: {spec.meaning}")
        splits[f"ood_distance/{name}"] = Field(
            "float32", axes, unit, f"from the training split's nearest: {spec.meaning}"
        )
    found |= {f"factors/{name}": field for name, field in config.scene.contract.derived.items()}
    joint = Field("bool", "n", "1", "whether the training split could not have drawn these factors")
    return found | (splits | {"out_of_distribution": joint} if config.splits else {})


class Sampler:
    """The draws of a config's scenes, whatever their split."""

    def __init__(self, config: Config) -> None:
        self.scene, self.laws, self.options = config.scene, config.laws, drawn_options(config.scene.contract)
        self.training = config.training.law if config.training else None
        self.lengths = sizes(config.scene)
        self.products = [product for law in self.laws for product in law.products]
        self.combinations = [law.combinations() for law in self.laws]
        self.gridded = sorted({name for names, _ in self.combinations for name in names})

    def combination(self, row: int, words: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        """For each video [n] what is given of its factors [n, G] float32: its combination of those that are on a grid.

        Each combination comes once before any comes again, in an order that the words (seed and split) decide.
        """
        names, every = self.combinations[row]
        found = np.zeros((len(numbers), len(self.gridded)), np.float32)
        if not names:
            return found
        seed = int(hashed(*map(int, words))[0] >> np.uint64(1))
        rounds, places = np.divmod(np.asarray(numbers, np.int64), len(every))
        for number in np.unique(rounds):
            own = rounds == number
            chosen = every[order(seed, int(number), places[own], len(every))]
            found[np.ix_(own, [self.gridded.index(name) for name in names])] = chosen
        return found

    def sampled(
        self, key: Array, row: Any = 0, given: Any = (), change: FactorChange | None = None
    ) -> tuple[SampledFactors, SampledScene]:
        """A video's factors, those that follow from others included, and its scene and start.

        `row` is that of the split, `given` [G] what `combination` says of the video. `change(found, draw)` makes other
        factors of those that are found, where `draw(key)` draws all anew.
        """
        draw_key, place_key = jax.random.split(key)
        drawn = self.drawn(draw_key, row, given, change)
        made: Any = self.scene.contract.sample(place_key, drawn, self.scene.options)
        rejected, fits = jnp.asarray(made.rejected, jnp.int32), jnp.asarray(made.fits, bool)
        return {**drawn, **made.derived}, made._replace(rejected=rejected, fits=fits, derived={})

    def drawn(self, key: Array, row: Any = 0, given: Any = (), change: FactorChange | None = None) -> SampledFactors:
        """A video's factors by name; zero for what is beyond the number there is."""
        found = self._sampled_factors(key, row, given)
        found = change(found, lambda other: self._sampled_factors(other, row, given)) if change else found
        return {name: self._counted(name, values, found) for name, values in found.items()}

    def _sampled_factors(self, key: Array, row: Any, given: Any) -> SampledFactors:
        """All factors by name. Each has a key of its own, so that its draws do not depend on which others there are."""
        components = self._components(key, row)
        found = {}
        for (name, spec), own in zip(self.options.items(), keys_for(key, [*self.options]), strict=True):
            shape = (self.lengths[spec.each],) if spec.each else ()
            keys = jax.random.split(own, spec.parts) if spec.parts else [own]
            which = components[spec.each]
            parts = [
                self._coordinate(k, coordinate, shape, which, row, given)
                for k, coordinate in zip(keys, self._coordinates(name), strict=True)
            ]
            found[name] = jnp.stack(parts, axis=-1) if spec.parts else parts[0]
        return found

    def _coordinates(self, name: str) -> list[str]:
        return list(coordinates(name, getattr(self.scene.options, name)))

    def _coordinate(self, key: Array, name: str, shape: tuple[int, ...], which: Array, row: Any, given: Any) -> Array:
        """One coordinate's draws, from the distribution that its product has."""
        own = [product.parts[name] for product in self.products]
        distinct = list(dict.fromkeys(own))
        draws = [source.sample(key, shape) for source in distinct]
        if len(draws) > 1:
            index = jnp.asarray([distinct.index(source) for source in own])[which]
            values = jnp.select([index == i for i in range(len(draws))], draws)
        else:
            values = draws[0]
        if name not in self.gridded:
            return values
        here = jnp.asarray([name in names for names, _ in self.combinations])[row]
        return jnp.where(here, given[self.gridded.index(name)].astype(values.dtype), values)

    def _components(self, key: Array, row: Any) -> dict[str, Array]:
        """By axis ("" is the video) the number of the product that is drawn from, of all splits' one after the other.

        A law whose products differ in numbers of one axis alone, such as each ball's, is drawn from for each of these.
        """
        counts = [len(law.products) for law in self.laws]
        firsts = jnp.asarray(np.cumsum([0, *counts[:-1]]))[row]
        if max(counts) == 1:
            return {"": firsts} | {axis: jnp.full(length, firsts) for axis, length in self.lengths.items()}
        ends = np.full((len(counts), max(counts)), 2.0, np.float32)
        for i, law in enumerate(self.laws):
            ends[i, : counts[i] - 1] = np.cumsum([product.share for product in law.products])[:-1]
        own, axes = key_for(key, "product"), [self._axis(law) for law in self.laws]

        def pick(key: Array, shape: tuple[int, ...]) -> Array:
            return firsts + (jax.random.uniform(key, shape)[..., None] >= jnp.asarray(ends)[row]).sum(-1)

        common = pick(own, ())
        found = {"": common}
        for axis, length in self.lengths.items():
            each = jnp.asarray([a == axis for a in axes])[row]
            found[axis] = jnp.where(each, pick(key_for(own, axis), (length,)), common)
        return found

    def _axis(self, law: JointDistribution) -> str:
        found = {self.options[name.partition("[")[0]].each for name in law.differing}
        return found.pop() if len(found) == 1 else ""

    def _counted(self, name: str, values: Array, found: SampledFactors) -> Array:
        each = self.options[name].each
        return values if each not in found else jnp.where(_there(each, values, found), values, 0)

    # ---- How far from the training split

    def outside(self, drawn: SampledFactors) -> dict[str, Array]:
        """By stored name how far each factor lies from what the training split can give, and whether all of them do."""
        if self.training is None:
            return {}
        found = {f"ood_distance/{name}": self._distance(name, drawn) for name in self.options}
        return found | {"out_of_distribution": ~self._inside(self.training, drawn)}

    def _distance(self, name: str, drawn: SampledFactors) -> Array:
        assert self.training is not None
        values, names = drawn[name], self._coordinates(name)
        parts = jnp.moveaxis(values, -1, 0) if self.options[name].parts else values[None]
        far = [_far(part, self.training.spans(own)) for part, own in zip(parts, names, strict=True)]
        distance = jnp.stack(far, axis=-1) if self.options[name].parts else far[0]
        return self._counted(name, distance, drawn)

    def _inside(self, law: JointDistribution, drawn: SampledFactors) -> Array:
        """Whether a law can give these factors: all of them from one product, or each thing's from one of its own."""
        axis = self._axis(law)
        fits = []
        for product in law.products:
            of_video, of_each = jnp.asarray(True), jnp.ones(self.lengths[axis] if axis else (), bool)
            for name, spec in self.options.items():
                inside = self._held(product.parts, name, drawn)
                if spec.each and spec.each == axis:
                    of_each &= inside | ~self._present(spec, inside, drawn)
                else:
                    of_video &= jnp.all(inside | ~self._present(spec, inside, drawn))
            fits.append(of_video & of_each)
        return jnp.all(functools.reduce(jnp.logical_or, fits))

    def _held(self, parts: Any, name: str, drawn: SampledFactors) -> Array:
        """Whether each of a factor's values lies in a product, all parts of a vector together."""
        values = drawn[name]
        each = jnp.moveaxis(values, -1, 0) if self.options[name].parts else values[None]
        far = [_far(part, parts[own].spans) for part, own in zip(each, self._coordinates(name), strict=True)]
        return functools.reduce(jnp.logical_and, [distance == 0 for distance in far])

    def _present(self, spec: Option, inside: Array, drawn: SampledFactors) -> Array:
        return _there(spec.each, inside, drawn) if spec.each in drawn else jnp.ones_like(inside)


def _there(each: str, values: Array, found: SampledFactors) -> Array:
    """Which of the counted things [K, ...] there are, like these values of them."""
    return (jnp.arange(values.shape[0]) < found[each]).reshape(-1, *[1] * (values.ndim - 1))


def _far(values: Array, spans: tuple[Span, ...]) -> Array:
    """How far each value is from the nearest of some spans; 0 within."""
    x = values.astype(jnp.float32)
    low = np.array([span.low for span in spans], np.float32)
    last = np.array([span.last for span in spans], np.float32)
    return jnp.maximum(jnp.maximum(low - x[..., None], x[..., None] - last), 0).min(-1)
