"""Sampling of a video's scene: factors are sampled from its key, and the family builds the scene from them.

A factor is an option with a distribution. It has one value per video, or one per object along the axis that its `each`
names. The axis is either another factor, a count such as `balls` whose largest value is the axis's length, or a size
that the family fixes.

Each split has its own joint distribution (config/joint_distribution.py). One program samples from all of them; the row
of the split is an argument.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.config.config import Config
from gen2d.config.distributions import Distribution, draws, stacked, thresholds
from gen2d.config.joint_distribution import Component, JointDistribution, distinct_parts
from gen2d.config.options import coordinates, factor_options
from gen2d.config.plugin_options import Plugin
from gen2d.config.random_requests import Draws, RandomRequest, answer_requests, answer_together, split
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
        self.gridded = sorted({name for joint in self.distributions for name in joint.gridded})

    @functools.cached_property
    def combinations(self) -> list[np.ndarray]:
        """Combinations [M, G] of the values of each split's factors on a grid."""
        return [joint.combinations() for joint in self.distributions]

    def grid_values(self, row: int, words: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        """Values [n, G] float32 of the factors on a grid: a combination for each video number [n].

        Every combination occurs once before any is repeated, in an order that depends on `words` (seed and split).
        """
        names = self.distributions[row].gridded
        values = np.zeros((len(numbers), len(self.gridded)), np.float32)
        if not names:
            return values
        every = self.combinations[row]
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
        components, factors = self._components(key, row), {}
        keys = dict(zip(self.options, keys_for(key, [*self.options]), strict=True))
        several = {name: spec.parts for name, spec in self.options.items() if spec.parts}
        part_keys = answer_requests([RandomRequest(split, keys[name], (parts,)) for name, parts in several.items()])
        keys_of = {name: [key] for name, key in keys.items()} | dict(zip(several, part_keys, strict=True))
        coordinate_draws = [
            self._draws(k, coordinate, self.options[name].each, components, row, given)
            for name, own in keys_of.items()
            for k, coordinate in zip(own, self._coordinates(name), strict=True)
        ]
        samples = iter(answer_together(coordinate_draws))
        for name, spec in self.options.items():
            parts = [next(samples) for _ in keys_of[name]]
            factors[name] = jnp.stack(parts, axis=-1) if spec.parts else parts[0]
        return factors

    def _coordinates(self, name: str) -> list[str]:
        return list(coordinates(name, getattr(self.scene.options, name)))

    def _draws(self, key: Array, name: str, each: str, components: dict[str, Array], row: Any, given: Any) -> Draws:
        """Samples of one coordinate, from its distribution in the chosen product."""
        distributions, places = _distinct(self.products, name)
        index = jnp.asarray(places)[components[each]] if len(distributions) > 1 else 0
        values = yield from draws(distributions, index, key, (self.lengths[each],) if each else ())
        if name not in self.gridded:
            return values
        on_grid = jnp.asarray([name in joint.gridded for joint in self.distributions])[row]
        return jnp.where(on_grid, given[self.gridded.index(name)].astype(values.dtype), values)

    def _components(self, key: Array, row: Any) -> dict[str, Array]:
        """Index of the product to sample from, into the products of all splits, by axis ("" is the video).

        If a split's products differ only in factors of one axis, a product is sampled for each of its objects. For
        example, {radius: small, color: red} or {radius: large, color: blue} for balls gives videos with both sorts.
        """
        counts = [len(joint.products) for joint in self.distributions]
        firsts = jnp.asarray(np.cumsum([0, *counts[:-1]]))[row]
        if max(counts) == 1:
            return dict.fromkeys(["", *self.lengths], firsts)
        shares = [[product.share for product in joint.products] for joint in self.distributions]
        ends = jnp.asarray(stacked(*(thresholds(max(counts), *own) for own in shares)), jnp.float32)
        axes = jnp.asarray(stacked(*map(self._axis, self.distributions)))[row]
        product_key = key_for(key, "product")

        def pick(key: Array, shape: tuple[int, ...]) -> Array:
            return firsts + (jax.random.uniform(key, shape)[..., None] >= ends[row]).sum(-1)

        common = pick(product_key, ())
        components = {"": common}
        for number, (axis, length) in enumerate(self.lengths.items(), 1):
            components[axis] = jnp.where(axes == number, pick(key_for(product_key, axis), (length,)), common)
        return components

    def _axis(self, joint: JointDistribution) -> Any:
        """Number of the only axis (from 1) of the factors in which the products differ; 0 if there are several."""
        names = [*joint.products[0].parts]
        axes = [["", *self.lengths].index(self.options[name.partition("[")[0]].each) for name in names]
        return _only(tuple(axes), *(_differ(distinct_parts(joint.products, name)) for name in names))

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
        distances, inside = {}, {}
        for name, spec in self.options.items():
            # Of each coordinate, from the support of each product.
            parts = jnp.stack([self._distances(*each) for each in self._values(name, factors)], axis=-2)
            nearest = parts.min(-1) if spec.parts else parts[..., 0, :].min(-1)
            distances[f"ood_distance/{name}"] = self._zero_absent(name, nearest, factors)
            inside[name] = (parts == 0).all(-2)
            if spec.each in factors:
                inside[name] |= ~_present(spec.each, inside[name], factors)
        return distances | {"out_of_distribution": ~self._in_support(inside)}

    def _values(self, name: str, factors: SampledFactors) -> list[tuple[str, Array]]:
        """Coordinates of a factor, and their values."""
        values = factors[name].astype(jnp.float32)
        parts = jnp.moveaxis(values, -1, 0) if self.options[name].parts else values[None]
        return list(zip(self._coordinates(name), parts, strict=True))

    def _distances(self, name: str, values: Array) -> Array:
        """Distance [..., P] of each value of a coordinate from its support in each product of the training split."""
        assert self.training is not None
        distributions, places = _distinct(self.training.products, name)
        intervals = [source.intervals for source in distributions]
        most = max(map(len, intervals))
        ends = [end for own in intervals for interval in [*own, *[own[0]] * (most - len(own))] for end in interval]
        low, last = jnp.moveaxis(jnp.asarray(stacked(*ends), jnp.float32).reshape(-1, most, 2), -1, 0)
        values = values[..., None, None]
        distances = jnp.maximum(jnp.maximum(low - values, values - last), 0).min(-1)
        return distances if len(distributions) == len(places) else distances[..., places]

    def _in_support(self, inside: dict[str, Array]) -> Array:
        """Whether the factors lie in the training split's support, from whether they do in each product [..., P].

        All must lie in one product or, if the products differ in factors of one axis, those of each object in its own.
        """
        assert self.training is not None
        results = []
        for axis in ["", *self.lengths] if len(self.training.products) > 1 else [""]:
            fits = jnp.asarray(True)
            for name, spec in self.options.items():
                fits &= inside[name] if spec.each in ("", axis) else inside[name].all(0)
            results.append(fits.any(-1).all())
        return jnp.stack(results)[jnp.asarray(self._axis(self.training))] if len(results) > 1 else results[0]


def _distinct(products: Sequence[Component], name: str) -> tuple[tuple[Distribution, ...], np.ndarray]:
    """Distinct distributions of a coordinate in these products, and the place of each product's among them."""
    distributions = distinct_parts(products, name)
    places = {id(source): place for place, source in enumerate(distributions)}
    return distributions, np.array([places[id(product.parts[name])] for product in products])


def _differ(distributions: Sequence[Distribution]) -> Any:
    """Whether some of these distributions differ."""
    kinds = {(source.form, *(part.form for part in source.parts)) for source in distributions}
    if len(kinds) > 1 or len(distributions) == 1:
        return len(kinds) > 1
    return _rows_differ(len(distributions), *(x for source in distributions for x in source.flat_numbers))


@recorded
def _rows_differ(count: int, *numbers: float) -> bool:
    rows = np.reshape(numbers, (count, -1))
    return bool((rows != rows[0]).any())


@recorded
def _only(axes: tuple[int, ...], *differing: bool) -> int:
    """The only axis of the coordinates that differ; 0 if there are several, or none."""
    distinct = {axis for axis, differs in zip(axes, differing, strict=True) if differs}
    return distinct.pop() if len(distinct) == 1 else 0


def _present(each: str, values: Array, factors: SampledFactors) -> Array:
    """Whether each of the counted objects is present; broadcasts to `values` [K, ...]."""
    return (jnp.arange(values.shape[0]) < factors[each]).reshape(-1, *[1] * (values.ndim - 1))
