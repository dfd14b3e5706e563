"""Joint distributions ('laws') over a scene's factors, for splits: products, mixtures, differences and intersections.

In a config a law is written relative to the scene's own distributions, the base:

    {radius: [1, 2], speed: 3}                      a product: these factors as given, all others as in the base
    {mixture: [LAW, ...], weights: [...]}           a mixture of laws
    {minus: [LAW, REGION, ...]}                     the law outside all regions
    {intersection: [LAW, REGION, ...]}              the law inside all regions
    {condition: [LAW, {when: REGION, then: {...}}]} the law, with other distributions for some factors in a region

A region is a product or a mixture of products; factors that it does not name are unconstrained. Every law is stored as
a mixture of products of one-dimensional distributions, one for each coordinate (`radius`, or `velocity[0]` of a
vector). This is closed under all operations above, as products truncated by boxes are mixtures of products. Hence laws
are sampled without rejection, and whether two laws have a point in common is decided exactly: they do if two of their
products overlap in every coordinate.
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

Weighted = dict[str, Distribution]  # distribution of each coordinate
SupportBox = dict[str, tuple[Span, ...]]  # support of each coordinate; others are unconstrained
ReadValue = Callable[[Mapping[str, Any]], Weighted]  # parses {factor: value}; raises ValueError
COMPOSED = ("mixture", "minus", "intersection", "condition")
MOST_PRODUCTS = 1000
MOST_COMPARED = 20_000_000  # pairs of spans compared for two laws
MOST_COMBINATIONS = 1_000_000  # of a grid


@dataclasses.dataclass(frozen=True)
class Component:
    """A product distribution (independent coordinates) and its probability in a mixture."""

    share: float
    parts: Mapping[str, Distribution]


@dataclasses.dataclass(frozen=True)
class JointDistribution:
    """A mixture of product distributions over the same coordinates."""

    products: tuple[Component, ...]

    @property
    def differing(self) -> list[str]:
        """Names of the coordinates whose distribution differs between products."""
        parts = [product.parts for product in self.products]
        return [name for name in parts[0] if any(other[name] != parts[0][name] for other in parts)]

    def contains(self, values: Mapping[str, Any]) -> np.ndarray:
        """Whether each point lies in the support. `values` holds arrays by coordinate; missing coordinates are free."""
        known = [name for name in self.products[0].parts if name in values]
        inside = [[product.parts[name].contains(values[name]) for name in known] for product in self.products]
        return np.any([np.all(np.broadcast_arrays(*each), axis=0) for each in inside], axis=0)

    def spans(self, name: str) -> tuple[Span, ...]:
        """Support of one coordinate, as spans."""
        return tuple(dict.fromkeys(span for product in self.products for span in product.parts[name].spans))

    def combinations(self) -> tuple[list[str], np.ndarray]:
        """Names of the G coordinates on a grid, and their M distinct combinations, float32 [M, G]."""
        names = [name for name, part in self.products[0].parts.items() if on_grid(part)]
        grids = [itertools.product(*(_values(p.parts[name]) for name in names)) for p in self.products]
        distinct = dict.fromkeys(itertools.islice(itertools.chain(*grids), MOST_COMBINATIONS + 1))
        return names, np.array(list(distinct), np.float32).reshape(len(distinct), len(names))


def on_grid(part: Distribution) -> bool:
    return any(simple.kind == "grid" for _, simple in part.weighted)


def _values(part: Distribution) -> list[float]:
    return [x for _, simple in part.weighted for x in simple.numbers]


def joint_distribution_of(written: Any, base: Weighted, read: ReadValue) -> JointDistribution:
    """The law written as `written` in a config, relative to a base.

    Raises ValueError, whose message is the syntax allowed, if the value is no law.
    """
    products = _products(written, base, read)
    total_share = sum(product.share for product in products)
    law = JointDistribution(tuple(Component(product.share / total_share, product.parts) for product in products))
    _check_grid(law)
    return law


def _check_grid(law: JointDistribution) -> None:
    names, combinations = law.combinations()
    if names and set(law.differing) - set(names):
        raise ValueError("of laws whose products differ in nothing but the grid, where there is one")
    if len(combinations) > MOST_COMBINATIONS:
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
    components = _products(operands[0], base, read)
    for operand in operands[1:]:
        components = _changed(kind, components, operand, read)
        if not components:
            raise ValueError(f"{kind} that leaves something")
        if len(components) > MOST_PRODUCTS:
            raise ValueError(f"a law of at most {MOST_PRODUCTS} products")
    return components


def _changed(kind: str, products: list[Component], operand: Any, read: ReadValue) -> list[Component]:
    """The products after one operand of `minus`, `intersection` or `condition`."""
    if kind != "condition":
        return _cut(products, _region(operand, read), keep=kind == "intersection")
    if not isinstance(operand, Mapping) or operand.keys() != {"when", "then"}:
        raise ValueError("condition: [law, {when: region, then: {factor: ...}}, ...]")
    region, changes = _region(operand["when"], read), read(operand["then"])
    inside = [Component(p.share, {**p.parts, **changes}) for p in _cut(products, region, keep=True)]
    return _cut(products, region, keep=False) + inside


def _region(written: Any, read: ReadValue) -> list[SupportBox]:
    """Boxes whose union is the region."""
    if isinstance(written, Mapping) and written.keys() & (set(COMPOSED) - {"mixture"}):
        raise ValueError("regions that are products, or mixtures of them")
    return [{name: part.spans for name, part in p.parts.items()} for p in _products(written, {}, read)]


def _cut(products: list[Component], boxes: list[SupportBox], keep: bool) -> list[Component]:
    """The parts of the products inside the union of the boxes or, without `keep`, outside it."""
    inside, outside = [], products
    for box in boxes:
        split = [_split(product, box) for product in outside]
        inside += [product for kept, _ in split for product in kept]
        outside = [product for _, left in split for product in left]
    return inside if keep else outside


def _split(product: Component, box: SupportBox) -> tuple[list[Component], list[Component]]:
    """A product's part inside a box, and its parts outside, cut off one coordinate after the other."""
    outside, inside = [], product
    for name, spans in box.items():
        distribution = inside.parts[name]
        outside += _with(inside, name, truncation.outside(distribution, spans))
        kept = _with(inside, name, truncation.inside(distribution, spans))
        if not kept:
            return [], outside
        inside = kept[0]
    return [inside], outside


def _with(product: Component, name: str, pieces: truncation.Intervals) -> list[Component]:
    """The product with one coordinate truncated to these pieces; an empty list if there are none."""
    if not pieces:
        return []
    return [Component(product.share * truncation.total(pieces), {**product.parts, name: truncation.mixture(pieces)})]


def intersect(one: JointDistribution, other: JointDistribution) -> dict[str, float] | None:
    """A point in the supports of both laws, by coordinate; None if they are disjoint.

    Raises ValueError if the laws have too many parts to compare.
    """
    spans = [max(len(spans) for p in law.products for spans in _spans_of(p)) for law in (one, other)]
    if len(one.products) * len(other.products) * spans[0] * spans[1] > MOST_COMPARED:
        raise ValueError("of fewer and simpler parts, as it would take too long to prove that splits are disjoint")
    for a, b in itertools.product(one.products, other.products):
        point = {name: _common(a.parts[name].spans, b.parts[name].spans) for name in a.parts}
        if all(x is not None for x in point.values()):
            return {name: x for name, x in point.items() if x is not None}
    return None


def _spans_of(product: Component) -> list[tuple[Span, ...]]:
    return [part.spans for part in product.parts.values()] or [()]


def _common(one: Sequence[Span], other: Sequence[Span]) -> float | None:
    for a, b in itertools.product(one, other):
        overlap = a.meet(b)
        if overlap is not None:
            return _of(overlap)
    return None


def _of(span: Span) -> float:
    """A number in the span: its lowest, or one near 0 if it has no lower end."""
    low = span.low if math.isfinite(span.low) else min(0.0, span.last)
    return float(math.ceil(low)) if span.whole else low


def union_support(laws: Sequence[JointDistribution]) -> Weighted:
    """For each coordinate, a distribution whose support contains those of all laws."""
    names = laws[0].products[0].parts
    products = [product for law in laws for product in law.products]
    return {name: truncation.mixture([(product.share, product.parts[name]) for product in products]) for name in names}
