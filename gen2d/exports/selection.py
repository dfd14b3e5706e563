"""Videos that are selected by their values, as `--select 'factors/balls > 3 and index < 100'` says."""

import operator
import re
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from gen2d.core.errors import ConfigError
from gen2d.loading import dataset as loader
from gen2d.loading.dataset import Dataset

SCANNED = 4096  # videos whose values are read at once
COMPARISONS: dict[str, Callable[[Any, Any], Any]] = {
    "<=": operator.le,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    ">": operator.gt,
}
_CONDITION = re.compile(
    rf"(?P<name>[\w/.-]+?)\s*(\[(?P<indices>\d+(\s*,\s*\d+)*)\])?\s*(?P<sign>{'|'.join(COMPARISONS)})\s*(?P<value>.+)"
)
_EXAMPLE = "'factors/balls > 3 and index < 100' or 'factors/gravity[1] < -5'"


def selected(ds: Dataset, conditions: str) -> np.ndarray:
    """Numbers of the videos of which all conditions are true, ascending, int64; no frames are read.

    Conditions are joined by `and`; each compares a field of one value per video, or one of its values by its indices,
    with a number or a text. Raises ConfigError, also if there is no such video.
    """
    parts = [_CONDITION.fullmatch(part.strip()) for part in re.split(r"\s+and\s+", conditions.strip())]
    found = np.ones(len(ds), bool)
    for part in parts:
        if part is None:
            raise ConfigError(f"--select is {conditions!r}, but must be conditions such as {_EXAMPLE}")
        indices = tuple(int(index) for index in re.findall(r"\d+", part["indices"] or ""))
        compare, value = COMPARISONS[part["sign"]], part["value"].strip("\"'")
        own = loader.open(ds.root, ds.options.split, fields=(part["name"],), snapshot=ds.snapshot)
        index = _checked(own, conditions, part["name"], indices)
        for first in range(0, len(ds), SCANNED):
            values = own[first : first + SCANNED][part["name"]][index]
            found[first : first + SCANNED] &= compare(values, _value(conditions, values, value))
    numbers = np.flatnonzero(found).astype(np.int64)
    if not len(numbers):
        raise ConfigError(f"--select is {conditions!r}, but no video of the split {ds.options.split} is like that")
    return numbers


def _checked(own: Dataset, conditions: str, name: str, indices: Sequence[int]) -> tuple[Any, ...]:
    """Index of one value per video in the field of `own`; raises ConfigError."""
    if name not in own.fields:
        raise ConfigError(f"--select is {conditions!r}, but names no field: the name must be whole")
    shape = own.fields[name].shape(own.sizes)
    if len(indices) != len(shape) or any(index >= size for index, size in zip(indices, shape, strict=False)):
        need = f"{len(shape)} indices below {', '.join(map(str, shape))}" if shape else "no index"
        example = f", such as {name}[{','.join('0' for _ in shape)}]" if shape else ""
        raise ConfigError(f"--select is {conditions!r}, but {name} takes {need}{example}")
    return (slice(None), *indices)


def _value(conditions: str, values: np.ndarray, text: str) -> Any:
    """The text as a value that can be compared with these; raises ConfigError."""
    if values.dtype.kind == "S":
        return np.bytes_(text.encode())
    if values.dtype.kind == "b" and text.lower() in ("true", "false"):
        return text.lower() == "true"
    try:
        return float(text)
    except ValueError:
        raise ConfigError(f"--select is {conditions!r}, but {text!r} is no number") from None
