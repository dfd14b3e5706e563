"""The syntax of distributions in a config.

    0.5                                      a constant
    [low, high]                              a uniform range (for a whole-number option: integers, both ends included)
    {log_uniform: [low, high]}               a named distribution, one of KINDS
    {mixture: [A, B, ...], weights: [...]}   a mixture
    {minus: [A, B, ...]}                     A restricted to values outside the supports of B, ...
    {intersection: [A, B, ...]}              A restricted to values inside the supports of B, ...

A vector is a list of such values.
"""

from collections.abc import Mapping
from numbers import Integral, Real
from typing import Any

from gen2d.config import truncation
from gen2d.config.distributions import Distribution

LENGTHS = {"constant": (1,), "uniform": (2,), "log_uniform": (2,), "integer": (2,), "normal": (2, 4)}
KINDS = (*LENGTHS, "choice", "grid")
COMPOSED = ("mixture", "minus", "intersection")
FORMS = "a number, [low, high], or one of " + ", ".join(f"{{{kind}: [...]}}" for kind in (*KINDS[1:], *COMPOSED))


MAX_NUMBERS = 10_000  # numbers in a list, at most
MAX_PARTS = 200  # components of a distribution, at most
MAX_MAGNITUDE = 1e12  # in any unit; its square, times other quantities, still fits in a float32


def is_number(value: Any) -> bool:
    """Whether the value is a real number of magnitude `MAX_MAGNITUDE` at most."""
    if isinstance(value, int):  # may be too large for float()
        return not isinstance(value, bool) and abs(value) <= MAX_MAGNITUDE
    return isinstance(value, Real) and abs(float(value)) <= MAX_MAGNITUDE


def parse(value: Any, whole: bool = False) -> Distribution:
    """The Distribution written as `value` in a config; `whole` allows whole numbers only.

    Raises ValueError, whose message is the syntax allowed, if the value is no distribution.
    """
    if isinstance(value, dict) and value.keys() & set(COMPOSED):
        return _parse_composed(value, whole)
    kind: str
    numbers: Any
    if is_number(value):
        kind, numbers = "constant", [value]
    elif isinstance(value, list | tuple):
        kind, numbers = "integer" if whole else "uniform", value
    elif isinstance(value, dict) and len(value) == 1 and next(iter(value)) in KINDS:
        kind, numbers = next(iter(value.items()))
        kind = "integer" if whole and kind == "uniform" else kind
    else:
        raise ValueError(FORMS)
    if not isinstance(numbers, list | tuple) or not 0 < len(numbers) <= MAX_NUMBERS or not all(map(is_number, numbers)):
        raise ValueError(f"{kind} of finite numbers in a list, {MAX_NUMBERS:,} at most")
    if kind in LENGTHS and len(numbers) not in LENGTHS[kind]:
        raise ValueError(f"{kind} of {' or '.join(map(str, LENGTHS[kind]))} numbers")
    if kind in ("uniform", "log_uniform", "integer") and numbers[0] > numbers[1]:
        raise ValueError("a range with its lower end first")
    if kind == "log_uniform" and numbers[0] <= 0:
        raise ValueError("a log_uniform range above 0")
    if len(numbers) == 4 and kind == "normal" and truncation.far_in_tail(*numbers):
        raise ValueError("a normal cut off within 4 deviations of its mean")
    if kind == "normal" and (numbers[1] <= 0 or (len(numbers) == 4 and numbers[2] >= numbers[3])):
        raise ValueError("normal: [mean, deviation above 0] or [mean, deviation, low, high]")
    if (whole or kind == "integer") and not all(float(x).is_integer() for x in numbers):
        raise ValueError("whole numbers")
    if kind == "integer" and not all(abs(x) < 2**31 - 1 for x in numbers):
        raise ValueError("whole numbers between -2**31 and 2**31")
    if kind == "grid" and len(set(numbers)) < len(numbers):
        raise ValueError("a grid of different numbers")
    if whole and kind in ("log_uniform", "normal"):
        raise ValueError("a whole number, [low, high] or {choice: [...]}")
    return Distribution(kind, tuple(int(x) if isinstance(x, Integral) else float(x) for x in numbers))


def _parse_composed(value: Mapping[str, Any], whole: bool) -> Distribution:
    """A mixture, or a distribution restricted by the supports of others."""
    kind, operands = next((kind, value[kind]) for kind in COMPOSED if kind in value)
    if value.keys() - {kind, *(["weights"] if kind == "mixture" else [])}:
        raise ValueError(FORMS)
    if not isinstance(operands, list | tuple) or not 0 < len(operands) <= MAX_PARTS:
        raise ValueError(f"{kind} of a list of distributions, {MAX_PARTS} at most")
    parts = [parse(part, whole) for part in operands]
    if kind == "mixture":
        return truncation.mixture(list(zip(checked_weights(value.get("weights"), len(parts)), parts, strict=True)))
    cut, source = (truncation.outside if kind == "minus" else truncation.inside), parts[0]
    for part in parts[1:]:
        pieces = cut(source, part.spans)
        if not pieces:
            raise ValueError(f"{'an' if kind == 'intersection' else 'a'} {kind} that leaves something")
        source = truncation.mixture(pieces)
        if len(source.weighted) > MAX_PARTS:
            raise ValueError(f"a {kind} that leaves {MAX_PARTS} parts at most")
    return source


def checked_weights(weights: Any, count: int) -> list[float]:
    """`count` weights, all 1 if `weights` is None. Raises ValueError if they are not `count` numbers above 0."""
    weights = [1] * count if weights is None else weights
    fits = isinstance(weights, list | tuple) and len(weights) == count and all(map(is_number, weights))
    if not fits or min(weights) <= 0:
        raise ValueError(f"a mixture of as many weights as parts, {count} numbers above 0")
    return [float(weight) for weight in weights]
