"""Sampling of a video's scene: factors are sampled from its key, and the family builds the scene from them.

A factor is an option with a distribution. It has one value per video, or one per object along the axis that its `each`
names. The axis is either another factor, a count such as `balls` whose largest value is the axis's length, or a size
that the family fixes.

Each split has its own joint distribution (config/joint_distribution.py). One program samples from all of them; the row
of the split is an argument.
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
from gen2d.config.options import Option, coordinates, factor_options
from gen2d.config.plugin_options import Plugin
from gen2d.core.permutation import hashed
from gen2d.core.schema import Field
from gen2d.loading.epochs import order
from gen2d.records.axes import Array
from gen2d.records.keys import key_for, keys_for
from gen2d.records.parameter import recorded
from gen2d.sampling.builder import SampledScene

SampledFactors = dict[str, Array]
FactorChange = Callable[[SampledFactors, Callable[[Array], SampledFactors]], SampledFactors]


def sizes(scene: Plugin) -> dict[str, int]:
    """Lengths of the factors' axes: the largest possible counts, and the sizes that the family fixes."""
    fixed = dict(scene.contract.sizes(scene.options))
    counted = {spec.each for spec in factor_options(scene.contract).values() if spec.each} - fixed.keys()
    return fixed | {each: int(getattr(scene.options, each).support[1]) for each in sorted(counted)}


def fields(config: Config) -> dict[str, Field]:
    """Stored fields of the factors, of the values that the family derives from them, and of splits."""
    stored, splits = {}, {}
    for name, spec in factor_options(config.scene.contract).items():
        axes = " ".join(["n", *([spec.each] if spec.each else []), *([str(spec.parts)] if spec.parts else [])])
        unit = spec.unit or "1"
        stored[f"factors/{name}"] = Field("float32", axes, unit, f"sampled {spec.meaning}")
        splits[f"ood_distance/{name}"] = Field(
            "float32", axes, unit, f"distance to the support of the training split: {spec.meaning}"
        )
    stored |= {f"factors/{name}": field for name, field in config.scene.contract.derived.items()}
    ood = Field("bool", "n", "1", "whether the factors lie outside the support of the training split")
    return stored | (splits | {"out_of_distribution": ood} if config.splits else {})


class Sampler:
    """Sampler of a config's scenes, for all its splits."""

    def __init__(self, config: Config) -> None:
        self.scene, self.options = config.scene, factor_options(config.scene.contract)
        self.distributions = config.joint_distributions
        self.training = config.training.distribution if config.training else None
        self.lengths = sizes(config.scene)
        self.products = [product for joint in self.distributions for product in joint.products]
        self.combinations = [joint.combinations() for joint in self.distributions]
        self.gridded = sorted({name for names, _ in self.combinations for name in names})

    def grid_values(self, row: int, words: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        """Values [n, G] float32 of the factors on a grid: a combination for each video number [n].

        Every combination occurs once before any is repeated, in an order that depends on `words` (seed and split).
        """
        names, every = self.combinations[row]
        values = np.zeros((len(numbers), len(self.gridded)), np.float32)
        if not names:
            return values
        seed = int(hashed(*map(int, words))[0] >> np.uint64(1))
        rounds, places = np.divmod(np.asarray(numbers, np.int64), len(every))
        for number in np.unique(rounds):
            videos = rounds == number
            rows = every[order(seed, int(number), places[videos], len(every))]
            values[np.ix_(videos, [self.gridded.index(name) for name in names])] = rows
        return values

    def sample(
        self, key: Array, row: Any = 0, given: Any = (), change: FactorChange | None = None
    ) -> tuple[SampledFactors, SampledScene]:
        """Factors of a video, including derived values, and its scene and initial state.

        `row` is that of the split, `given` [G] the video's `grid_values`. `change(factors, draw)` returns replacements
        of all factors, where `draw(key)` samples them from another key.
        """
        draw_key, place_key = jax.random.split(key)
        factors = self.sample_factors(draw_key, row, given, change)
        scene: Any = self.scene.contract.sample(place_key, factors, self.scene.options)
        rejected, fits = jnp.asarray(scene.rejected, jnp.int32), jnp.asarray(scene.fits, bool)
        return {**factors, **scene.derived}, scene._replace(rejected=rejected, fits=fits, derived={})

    def sample_factors(
        self, key: Array, row: Any = 0, given: Any = (), change: FactorChange | None = None
    ) -> SampledFactors:
        """Factors of a video by name, without derived values; zero for objects beyond the sampled count."""
        factors = self._unmasked_factors(key, row, given)
        factors = change(factors, lambda other: self._unmasked_factors(other, row, given)) if change else factors
        return {name: self._zero_absent(name, values, factors) for name, values in factors.items()}

    def _unmasked_factors(self, key: Array, row: Any, given: Any) -> SampledFactors:
        """All factors by name; each has its own key, so its samples do not depend on the other factors."""
        components = self._components(key, row)
        factors = {}
        for (name, spec), factor_key in zip(self.options.items(), keys_for(key, [*self.options]), strict=True):
            shape = (self.lengths[spec.each],) if spec.each else ()
            keys = jax.random.split(factor_key, spec.parts) if spec.parts else [factor_key]
            which = components[spec.each]
            parts = [
                self._coordinate(k, coordinate, shape, which, row, given)
                for k, coordinate in zip(keys, self._coordinates(name), strict=True)
            ]
            factors[name] = jnp.stack(parts, axis=-1) if spec.parts else parts[0]
        return factors

    def _coordinates(self, name: str) -> list[str]:
        return list(coordinates(name, getattr(self.scene.options, name)))

    def _coordinate(self, key: Array, name: str, shape: tuple[int, ...], which: Array, row: Any, given: Any) -> Array:
        """Samples of one coordinate, from its distribution in the chosen product."""
        distributions = [product.parts[name] for product in self.products]
        distinct = list(dict.fromkeys(distributions))
        draws = [source.sample(key, shape) for source in distinct]
        if len(draws) > 1:
            index = jnp.asarray([distinct.index(source) for source in distributions])[which]
            values = jnp.select([index == i for i in range(len(draws))], draws)
        else:
            values = draws[0]
        if name not in self.gridded:
            return values
        on_grid = jnp.asarray([name in names for names, _ in self.combinations])[row]
        return jnp.where(on_grid, given[self.gridded.index(name)].astype(values.dtype), values)

    def _components(self, key: Array, row: Any) -> dict[str, Array]:
        """Index of the product to sample from, into the products of all splits, by axis ("" is the video).

        If a split's products differ only in factors of one axis, a product is sampled for each of its objects. For
        example, {radius: small, color: red} or {radius: large, color: blue} for balls gives videos with both sorts.
        """
        counts = [len(joint.products) for joint in self.distributions]
        firsts = jnp.asarray(np.cumsum([0, *counts[:-1]]))[row]
        if max(counts) == 1:
            return {"": firsts} | {axis: jnp.full(length, firsts) for axis, length in self.lengths.items()}
        shares = [[product.share for product in joint.products] for joint in self.distributions]
        ends = jnp.asarray([_thresholds(max(counts), *own) for own in shares], jnp.float32)
        product_key, axes = key_for(key, "product"), [self._axis(joint) for joint in self.distributions]

        def pick(key: Array, shape: tuple[int, ...]) -> Array:
            return firsts + (jax.random.uniform(key, shape)[..., None] >= ends[row]).sum(-1)

        common = pick(product_key, ())
        components = {"": common}
        for axis, length in self.lengths.items():
            each = jnp.asarray([a == axis for a in axes])[row]
            components[axis] = jnp.where(each, pick(key_for(product_key, axis), (length,)), common)
        return components

    def _axis(self, joint: JointDistribution) -> str:
        axes = {self.options[name.partition("[")[0]].each for name in joint.differing}
        return axes.pop() if len(axes) == 1 else ""

    def _zero_absent(self, name: str, values: Array, factors: SampledFactors) -> Array:
        each = self.options[name].each
        return values if each not in factors else jnp.where(_present(each, values, factors), values, 0)

    # ---- Distance from the training split

    def ood_distances(self, factors: SampledFactors) -> dict[str, Array]:
        """Distance of each factor from the training split's support, and whether they are outside it, by stored name.

        Empty without splits.
        """
        if self.training is None:
            return {}
        distances = {}
        for name, spec in self.options.items():
            parts = self._distances(name, factors, self.training.spans)
            distance = jnp.stack(parts, axis=-1) if spec.parts else parts[0]
            distances[f"ood_distance/{name}"] = self._zero_absent(name, distance, factors)
        return distances | {"out_of_distribution": ~self._in_support(self.training, factors)}

    def _distances(self, name: str, factors: SampledFactors, spans_of: Callable[[str], Any]) -> list[Array]:
        """Distance of each coordinate of a factor from its spans."""
        values, names = factors[name], self._coordinates(name)
        parts = jnp.moveaxis(values, -1, 0) if self.options[name].parts else values[None]
        return [_distance_to(part, spans_of(name)) for part, name in zip(parts, names, strict=True)]

    def _in_support(self, joint: JointDistribution, factors: SampledFactors) -> Array:
        """Whether these factors lie in the support: all in one product, or those of each object in its own product."""
        axis = self._axis(joint)
        fits = []
        for product in joint.products:
            of_video, of_each = jnp.asarray(True), jnp.ones(self.lengths[axis] if axis else (), bool)
            for name, spec in self.options.items():
                distances = self._distances(name, factors, lambda of, parts=product.parts: parts[of].spans)
                inside = functools.reduce(jnp.logical_and, [distance == 0 for distance in distances])
                if spec.each and spec.each == axis:
                    of_each &= inside | ~self._are_present(spec, inside, factors)
                else:
                    of_video &= jnp.all(inside | ~self._are_present(spec, inside, factors))
            fits.append(of_video & of_each)
        return jnp.all(functools.reduce(jnp.logical_or, fits))

    def _are_present(self, spec: Option, inside: Array, factors: SampledFactors) -> Array:
        return _present(spec.each, inside, factors) if spec.each in factors else jnp.ones_like(inside)


@recorded
def _thresholds(length: int, *shares: float) -> np.ndarray:
    """Cumulative probabilities [length] of products, without the last; 2 where there is none."""
    thresholds = np.full(length, 2.0)
    thresholds[: len(shares) - 1] = np.cumsum(shares)[:-1]
    return thresholds


def _present(each: str, values: Array, factors: SampledFactors) -> Array:
    """Whether each of the counted objects is present; broadcasts to `values` [K, ...]."""
    return (jnp.arange(values.shape[0]) < factors[each]).reshape(-1, *[1] * (values.ndim - 1))


def _distance_to(values: Array, spans: tuple[Span, ...]) -> Array:
    """Distance of each value from the nearest span; 0 inside one."""
    x = values.astype(jnp.float32)
    low, last = (jnp.asarray(ends, jnp.float32) for ends in ([s.low for s in spans], [s.last for s in spans]))
    return jnp.maximum(jnp.maximum(low - x[..., None], x[..., None] - last), 0).min(-1)
