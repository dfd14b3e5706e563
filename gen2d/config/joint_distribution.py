"""Joint distributions over a scene's factors, for splits: products, mixtures, and what is left of one without another.

In a config a law is written over the scene's own distributions, the base:

    {radius: [1, 2], speed: 3}                      these factors so, the others as in the base: a product
    {mixture: [LAW, ...], weights: [...]}           one of several laws
    {minus: [LAW, REGION, ...]}                     where it lies in none of the regions
    {intersection: [LAW, REGION, ...]}              where it lies in all of the regions
    {condition: [LAW, {when: REGION, then: {...}}]} where it lies in a region, other factors so

A region is a product or a mixture of products in which a factor that is not named may be anything. Whatever is written,
a law is a mixture of products of distributions of single numbers ('coordinates': `radius`, or `velocity[0]` of a
vector), for products cut by products are products again. So a law is drawn from without rejection, and two laws have a
number in common just if two of their products do in every coordinate: that is decided exactly.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from gen2d.config import truncation
from gen2d.config.distribution_syntax import checked_weights
from gen2d.config.distributions import Distribution, Span

Weighted = dict[str, Distribution]  # a distribution for each coordinate
SupportBox = dict[str, tuple[Span, ...]]  # where a coordinate must lie; what is not named may be anything
ReadValue = Callable[[Mapping[str, Any]], Weighted]  # from {factor: value} as written; ValueError with what is allowed
COMPOSED = ("mixture", "minus", "intersection", "condition")
MOST_PRODUCTS = 1000
MOST_COMPARED = 20_000_000  # pairs of spans of two laws
MOST_COMBINATIONS = 1_000_000  # of a grid


@dataclasses.dataclass(frozen=True)
class Component:
    """Independent coordinates, and the share of all draws that come from them."""

    share: float
    parts: Mapping[str, Distribution]


@dataclasses.dataclass(frozen=True)
class JointDistribution:
    """A mixture of products, all over the same coordinates."""

    products: tuple[Component, ...]

    @property
    def differing(self) -> list[str]:
        """The coordinates that do not have one distribution in all products."""
        parts = [product.parts for product in self.products]
        return [name for name in parts[0] if any(other[name] != parts[0][name] for other in parts)]

    def contains(self, values: Mapping[str, Any]) -> np.ndarray:
        """For each set of values, arrays by coordinate, whether the law can give it; others may be anything."""
        known = [name for name in self.products[0].parts if name in values]
        inside = [[product.parts[name].contains(values[name]) for name in known] for product in self.products]
        return np.any([np.all(np.broadcast_arrays(*each), axis=0) for each in inside], axis=0)

    def spans(self, name: str) -> tuple[Span, ...]:
        """Where a coordinate lies, whatever the others are."""
        return tuple(dict.fromkeys(span for product in self.products for span in product.parts[name].spans))

    def combinations(self) -> tuple[list[str], np.ndarray]:
        """The coordinates that are on a grid, and every combination [M, G] of them that the law can give, once."""
        names = [name for name, part in self.products[0].parts.items() if _on_grid(part)]
        found = [itertools.product(*(_values(p.parts[name]) for name in names)) for p in self.products]
        every = dict.fromkeys(itertools.islice(itertools.chain(*found), MOST_COMBINATIONS + 1))
        return names, np.array(list(every), np.float32).reshape(len(every), len(names))


def _on_grid(part: Distribution) -> bool:
    return any(simple.kind == "grid" for _, simple in part.weighted)


def _values(part: Distribution) -> list[float]:
    return [x for _, simple in part.weighted for x in simple.numbers]


def joint_distribution_of(written: Any, base: Weighted, read: ReadValue) -> JointDistribution:
    """The law that a config's value stands for over a base; ValueError with what is allowed if it stands for none."""
    products = _products(written, base, read)
    whole = sum(product.share for product in products)
    law = JointDistribution(tuple(Component(product.share / whole, product.parts) for product in products))
    _check_grid(law)
    return law


def _check_grid(law: JointDistribution) -> None:
    names, every = law.combinations()
    if names and set(law.differing) - set(names):
        raise ValueError("of laws whose products differ in nothing but the grid, where there is one")
    if len(every) > MOST_COMBINATIONS:
        raise ValueError(f"a grid of at most {MOST_COMBINATIONS:,} combinations")


def _products(written: Any, base: Weighted, read: ReadValue) -> list[Component]:
    if not isinstance(written, Mapping):
        raise ValueError("a mapping of factors, or one of " + ", ".join(f"{{{kind}: [...]}}" for kind in COMPOSED))
    kind = next((kind for kind in COMPOSED if kind in written), None)
    if kind is None:
        return [Component(1.0, base | read(written))]
    if written.keys() - {kind, *(["weights"] if kind == "mixture" else [])}:
        raise ValueError(f"{kind} alone, without {', '.join(sorted(written.keys() - {kind}))} beside it")
    operands = written[kind]
    if not isinstance(operands, list | tuple) or not operands:
        raise ValueError(f"{kind} of a list of laws")
    if kind == "mixture":
        weights = checked_weights(written.get("weights"), len(operands))
        each = [_products(operand, base, read) for operand in operands]
        return [Component(w * p.share, p.parts) for w, products in zip(weights, each, strict=True) for p in products]
    found = _products(operands[0], base, read)
    for operand in operands[1:]:
        found = _changed(kind, found, operand, read)
        if not found:
            raise ValueError(f"{kind} that leaves something")
        if len(found) > MOST_PRODUCTS:
            raise ValueError(f"a law of at most {MOST_PRODUCTS} products")
    return found


def _changed(kind: str, products: list[Component], operand: Any, read: ReadValue) -> list[Component]:
    """The products without a region, inside it, or otherwise in it."""
    if kind != "condition":
        return _cut(products, _region(operand, read), keep=kind == "intersection")
    if not isinstance(operand, Mapping) or operand.keys() != {"when", "then"}:
        raise ValueError("condition: [law, {when: region, then: {factor: ...}}, ...]")
    region, other = _region(operand["when"], read), read(operand["then"])
    inside = [Component(p.share, {**p.parts, **other}) for p in _cut(products, region, keep=True)]
    return _cut(products, region, keep=False) + inside


def _region(written: Any, read: ReadValue) -> list[SupportBox]:
    """The boxes that a region is the union of."""
    if isinstance(written, Mapping) and written.keys() & (set(COMPOSED) - {"mixture"}):
        raise ValueError("regions that are products, or mixtures of them")
    return [{name: part.spans for name, part in p.parts.items()} for p in _products(written, {}, read)]


def _cut(products: list[Component], boxes: list[SupportBox], keep: bool) -> list[Component]:
    """What of the products lies inside of any of the boxes, or (without `keep`) in none."""
    inside, rest = [], products
    for box in boxes:
        split = [_split(product, box) for product in rest]
        inside += [product for own, _ in split for product in own]
        rest = [product for _, others in split for product in others]
    return inside if keep else rest


def _split(product: Component, box: SupportBox) -> tuple[list[Component], list[Component]]:
    """What of a product lies inside a box, and what outside: in the first coordinate, or else in the second, ..."""
    outside, rest = [], product
    for name, spans in box.items():
        own = rest.parts[name]
        outside += _with(rest, name, truncation.outside(own, spans))
        kept = _with(rest, name, truncation.inside(own, spans))
        if not kept:
            return [], outside
        rest = kept[0]
    return [rest], outside


def _with(product: Component, name: str, pieces: truncation.Intervals) -> list[Component]:
    """The product with one coordinate cut to these pieces; nothing where there are none."""
    if not pieces:
        return []
    return [Component(product.share * truncation.total(pieces), {**product.parts, name: truncation.mixture(pieces)})]


def intersect(one: JointDistribution, other: JointDistribution) -> dict[str, float] | None:
    """A point that both laws can give, by coordinate; None if there is none."""
    spans = [max(len(spans) for p in law.products for spans in _spans_of(p)) for law in (one, other)]
    if len(one.products) * len(other.products) * spans[0] * spans[1] > MOST_COMPARED:
        raise ValueError("of fewer and simpler parts, as it would take too long to prove that splits are disjoint")
    for a, b in itertools.product(one.products, other.products):
        found = {name: _common(a.parts[name].spans, b.parts[name].spans) for name in a.parts}
        if all(x is not None for x in found.values()):
            return {name: x for name, x in found.items() if x is not None}
    return None


def _spans_of(product: Component) -> list[tuple[Span, ...]]:
    return [part.spans for part in product.parts.values()] or [()]


def _common(one: Sequence[Span], other: Sequence[Span]) -> float | None:
    for a, b in itertools.product(one, other):
        both = a.meet(b)
        if both is not None:
            return _of(both)
    return None


def _of(span: Span) -> float:
    """A number of a span: the lowest, or one near 0."""
    low = span.low if math.isfinite(span.low) else min(0.0, span.last)
    return float(math.ceil(low)) if span.whole else low


def union_support(laws: Sequence[JointDistribution]) -> Weighted:
    """For each coordinate a distribution that can give whatever any of the laws can."""
    names = laws[0].products[0].parts
    every = [product for law in laws for product in law.products]
    return {name: truncation.mixture([(product.share, product.parts[name]) for product in every]) for name in names}
