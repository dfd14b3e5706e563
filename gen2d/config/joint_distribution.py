"""Joint distributions of a scene's factors, for splits: products, mixtures, differences and intersections.

In a config a joint distribution J is written relative to the scene's own distributions, the base:

    {radius: [1, 2], speed: 3}                      a product: these factors as given, all others as in the base
    {mixture: [J, ...], weights: [...]}             a mixture of joint distributions
    {minus: [J, REGION, ...]}                       J outside all regions
    {intersection: [J, REGION, ...]}                J inside all regions
    {condition: [J, {when: REGION, then: {...}}]}   J, with other distributions for some factors in a region

A region is a product or a mixture of products; factors that it does not name are unconstrained. Every joint
distribution is stored as a mixture of products of one-dimensional distributions, one for each coordinate (`radius`, or
`velocity[0]` of a vector). This is closed under all operations above, as products truncated by boxes are mixtures of
products. Hence samples need no rejection, and whether two joint distributions have a point in common is decided
exactly: they do if two of their products overlap in every coordinate.
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

Marginals = dict[str, Distribution]  # distribution of each coordinate
SupportBox = dict[str, tuple[Span, ...]]  # support of each coordinate; others are unconstrained
ReadValue = Callable[[Mapping[str, Any]], Marginals]  # parses {factor: value}; raises ValueError
COMPOSED = ("mixture", "minus", "intersection", "condition")
MAX_PRODUCTS = 1000
MAX_COMPARED = 20_000_000  # pairs of spans compared for two joint distributions
MAX_COMBINATIONS = 1_000_000  # of a grid


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

    @property
    def gridded(self) -> list[str]:
        """Names of the coordinates on a grid."""
        return [name for name, part in self.products[0].parts.items() if on_grid(part)]

    def combinations(self) -> np.ndarray:
        """Distinct combinations [M, G] float32 of the values of the G coordinates on a grid.

        Raises ValueError if there are too many.
        """
        names = self.gridded
        axes = [
            [[x for _, simple in p.parts[name].weighted for x in simple.numbers] for name in names]
            for p in self.products
        ]
        grids = [itertools.product(*values) for values in axes]
        distinct = dict.fromkeys(itertools.islice(itertools.chain(*grids), MAX_COMBINATIONS + 1))
        if len(distinct) > MAX_COMBINATIONS:
            raise ValueError(f"a grid of at most {MAX_COMBINATIONS:,} combinations")
        return np.array(list(distinct), np.float32).reshape(len(distinct), len(names))


def on_grid(part: Distribution) -> bool:
    """Whether a distribution, or a component of it, is a grid."""
    return any(simple.kind == "grid" for _, simple in part.weighted)


def parse_distribution(written: Any, base: Marginals, read: ReadValue) -> JointDistribution:
    """The joint distribution written as `written` in a config, relative to a base.

    Raises ValueError, whose message is the syntax allowed, if the value is no joint distribution.
    """
    products = _parse_products(written, base, read)
    total_share = sum(product.share for product in products)
    joint = JointDistribution(tuple(Component(product.share / total_share, product.parts) for product in products))
    if joint.gridded and set(joint.differing) - set(joint.gridded):
        raise ValueError("of distributions whose products differ in the grid only, where there is one")
    joint.combinations()  # raises ValueError if there are too many
    return joint


def _parse_products(written: Any, base: Marginals, read: ReadValue) -> list[Component]:
    if not isinstance(written, Mapping):
        raise ValueError("a mapping of factors, or one of " + ", ".join(f"{{{kind}: [...]}}" for kind in COMPOSED))
    kind = next((kind for kind in COMPOSED if kind in written), None)
    if kind is None:
        return [Component(1.0, base | read(written))]
    if written.keys() - {kind, *(["weights"] if kind == "mixture" else [])}:
        raise ValueError(f"{kind} alone, without {', '.join(sorted(written.keys() - {kind}))} beside it")
    operands = written[kind]
    if not isinstance(operands, list | tuple) or not operands:
        raise ValueError(f"{kind} of a list of distributions")
    if kind == "mixture":
        weights = checked_weights(written.get("weights"), len(operands))
        each = [_parse_products(operand, base, read) for operand in operands]
        return [Component(w * p.share, p.parts) for w, products in zip(weights, each, strict=True) for p in products]
    components = _parse_products(operands[0], base, read)
    for operand in operands[1:]:
        components = _apply_operand(kind, components, operand, read)
        if not components:
            raise ValueError(f"{kind} that leaves something")
        if len(components) > MAX_PRODUCTS:
            raise ValueError(f"a distribution of at most {MAX_PRODUCTS} products")
    return components


def _apply_operand(kind: str, products: list[Component], operand: Any, read: ReadValue) -> list[Component]:
    """The products after one operand of `minus`, `intersection` or `condition`."""
    if kind != "condition":
        return _truncate(products, _parse_region(operand, read), keep=kind == "intersection")
    if not isinstance(operand, Mapping) or operand.keys() != {"when", "then"}:
        raise ValueError("condition: [distribution, {when: region, then: {factor: ...}}, ...]")
    region, changes = _parse_region(operand["when"], read), read(operand["then"])
    inside = [Component(p.share, {**p.parts, **changes}) for p in _truncate(products, region, keep=True)]
    return _truncate(products, region, keep=False) + inside


def _parse_region(written: Any, read: ReadValue) -> list[SupportBox]:
    """Boxes whose union is the region."""
    if isinstance(written, Mapping) and written.keys() & (set(COMPOSED) - {"mixture"}):
        raise ValueError("regions that are products, or mixtures of them")
    return [{name: part.spans for name, part in p.parts.items()} for p in _parse_products(written, {}, read)]


def _truncate(products: list[Component], boxes: list[SupportBox], keep: bool) -> list[Component]:
    """The parts of the products inside the union of the boxes or, without `keep`, outside it."""
    inside, outside = [], products
    for box in boxes:
        split = [_split_at_box(product, box) for product in outside]
        inside += [product for kept, _ in split for product in kept]
        outside = [product for _, left in split for product in left]
    return inside if keep else outside


def _split_at_box(product: Component, box: SupportBox) -> tuple[list[Component], list[Component]]:
    """A product's part inside a box, and its parts outside, cut off one coordinate after the other."""
    outside, inside = [], product
    for name, spans in box.items():
        distribution = inside.parts[name]
        outside += _with_coordinate(inside, name, truncation.outside(distribution, spans))
        kept = _with_coordinate(inside, name, truncation.inside(distribution, spans))
        if not kept:
            return [], outside
        inside = kept[0]
    return [inside], outside


def _with_coordinate(product: Component, name: str, pieces: truncation.Pieces) -> list[Component]:
    """The product with one coordinate truncated to these pieces; an empty list if there are none.

    The truncated distribution is a new object, even if it equals the old one (`union_support` says why).
    """
    if not pieces:
        return []
    part = dataclasses.replace(truncation.mixture(pieces))
    return [Component(product.share * truncation.total(pieces), {**product.parts, name: part})]


def intersect(one: JointDistribution, other: JointDistribution) -> dict[str, float] | None:
    """A point in the supports of both, by coordinate; None if they are disjoint.

    Raises ValueError if they have too many parts to compare.
    """
    spans = [max((len(q.spans) for p in joint.products for q in p.parts.values()), default=0) for joint in (one, other)]
    if len(one.products) * len(other.products) * spans[0] * spans[1] > MAX_COMPARED:
        raise ValueError("of fewer and simpler parts, as it would take too long to prove that splits are disjoint")
    for a, b in itertools.product(one.products, other.products):
        point = {name: _common_point(a.parts[name].spans, b.parts[name].spans) for name in a.parts}
        if all(x is not None for x in point.values()):
            return {name: x for name, x in point.items() if x is not None}
    return None


def _common_point(one: Sequence[Span], other: Sequence[Span]) -> float | None:
    """A number in both: the lowest of the first overlap, or one near 0 if that has no lower end; None if disjoint."""
    for a, b in itertools.product(one, other):
        overlap = a.intersect(b)
        if overlap is not None:
            low = overlap.low if math.isfinite(overlap.low) else min(0.0, overlap.last)
            return float(math.ceil(low)) if overlap.whole else low
    return None


def union_support(joints: Sequence[JointDistribution]) -> Marginals:
    """For each coordinate, a distribution whose support contains those of all joint distributions.

    It is a mixture of the distinct objects among their distributions, whether or not some are equal: which numbers
    programs take must not depend on their values.
    """
    products = [product for joint in joints for product in joint.products]
    distinct = {name: distinct_parts(products, name) for name in products[0].parts}
    return {
        name: parts[0] if len(parts) == 1 else Distribution("mixture", (1.0,) * len(parts), parts)
        for name, parts in distinct.items()
    }


def distinct_parts(products: Sequence[Component], name: str) -> tuple[Distribution, ...]:
    """Distributions of a coordinate in these products, each object once."""
    return tuple({id(product.parts[name]): product.parts[name] for product in products}.values())
