"""Compact form of the arrays that a page draws: 16-bit numbers, differences in time, deflate."""

import base64
from collections.abc import Mapping
from typing import Any

import numpy as np
from isal import isal_zlib

LEVEL = 3  # isal's strongest


def packed(arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Plain values, as in JSON, of float arrays [T, ...]; `page.js` unpacks them.

    A number becomes one of 65,535 steps from the least to the largest value of its array, and is stored as the
    difference from the frame before, all lower bytes first. Values that are not finite become the nearest finite one,
    or 0.
    """
    columns: list[dict[str, Any]] = []
    parts: list[bytes] = []
    for name, values in arrays.items():
        steps, low, step = _steps(values)
        steps[1:] -= steps[:-1].copy()  # modulo 2**16
        series = np.ascontiguousarray(np.moveaxis(steps, 0, -1)).reshape(-1)
        parts.append(series.astype("<u2").view(np.uint8).reshape(-1, 2).T.tobytes())
        columns.append({"name": name, "shape": values.shape, "low": low, "step": step})
    return {"columns": columns, "content": deflated(b"".join(parts))}


def deflated(content: bytes) -> str:
    """Compressed bytes as base64."""
    return base64.b64encode(isal_zlib.compress(content, LEVEL)).decode()


def _steps(values: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Steps, uint16, of float values, with the least value and the size of a step."""
    finite = np.isfinite(values)
    wide = np.where(finite, values, 0).astype(np.float64)
    low, high = (float(wide.min()), float(wide.max())) if wide.size else (0.0, 0.0)
    if not finite.all():
        wide = np.where(values == np.inf, high, np.where(values == -np.inf, low, wide))
    step = (high - low) / 65534 or 1.0
    if not np.isfinite(step):  # the range itself overflows
        return np.zeros(values.shape, np.uint16), 0.0, 1.0
    return np.rint((wide - low) / step).astype(np.uint16), low, step
