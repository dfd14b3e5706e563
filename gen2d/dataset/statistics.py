"""Statistics of fields per channel or component: moments of a video, merged over shards and splits.

Moments are count, sum, sum of squares, minimum and maximum.
"""

from collections.abc import Mapping

import numpy as np

from gen2d.core.schema import Field

# The values that enter the moments, as the manifest describes them.
SAMPLED = "frames: every 8th frame, of it every 4th row and column; states: every frame, objects that are present"
MOMENTS = 5

Stats = dict[str, dict[str, list[float] | None]]  # of each field: mean, std, min and max of each component


def component_counts(fields: Mapping[str, Field]) -> dict[str, int]:
    """The number of channels or components of each field that has statistics, sorted by name."""
    names = sorted(name for name, field in fields.items() if field.per_video and _is_measured(name))
    return {name: _components(fields[name]) for name in names}


def _is_measured(name: str) -> bool:
    return name == "frames" or name.startswith("states/")


def _components(field: Field) -> int:
    last = field.axes.split()[-1]
    return int(last) if last.isdigit() else 1


def moments_of(columns: Mapping[str, np.ndarray], fields: Mapping[str, Field]) -> dict[str, np.ndarray]:
    """The moments of each field that has statistics, float64 [m, 5, components], from columns [m, ...].

    Sums of uint8 are exact. Each video is summed by itself, so that the grouping of videos changes no bit.
    """
    present = columns.get("objects/present")
    return {
        name: _image_moments(columns[name], components)
        if fields[name].is_image
        else _moments(columns[name], fields[name], components, present)
        for name, components in component_counts(fields).items()
    }


def _moments(column: np.ndarray, field: Field, components: int, present: np.ndarray | None) -> np.ndarray:
    axes = field.axes.split()
    # Components before values, so that each sum runs over contiguous memory.
    values = column.reshape(len(column), -1, components).transpose(0, 2, 1).astype(np.float64, order="C")
    count, low, high = np.full(values.shape[:2], values.shape[2], np.float64), values, values
    if "K" in axes and present is not None:
        exists = _broadcast_presence(present, axes, column.shape)
        count = np.broadcast_to(exists, values.shape).sum(-1, dtype=np.float64)
        low, high = np.where(exists, values, np.inf), np.where(exists, values, -np.inf)
        values = np.where(exists, values, 0.0)
    sums = count, values.sum(-1), (values * values).sum(-1)
    return np.stack([*sums, low.min(-1, initial=np.inf), high.max(-1, initial=-np.inf)], axis=1)


def _image_moments(images: np.ndarray, components: int) -> np.ndarray:
    """The moments of uint8 images [m, T, H, W, ...], in integers, which takes half as long."""
    sample = images[:, ::8, ::4, ::4]  # all pixels would take longer than the rest of `encode`
    values = np.ascontiguousarray(sample.reshape(len(images), -1, components).transpose(0, 2, 1))
    wide = values.astype(np.uint32)
    count = np.full(values.shape[:2], values.shape[2], np.float64)
    return np.stack([count, wide.sum(-1), (wide * wide).sum(-1), values.min(-1), values.max(-1)], axis=1)


def _broadcast_presence(present: np.ndarray, axes: list[str], shape: tuple[int, ...]) -> np.ndarray:
    """Whether the object of each value is present, bool [m, 1, values]; `present` is [m, K]."""
    steps = [size if axis in "nK" else 1 for axis, size in zip(axes, shape, strict=True) if not axis.isdigit()]
    return np.broadcast_to(present.reshape(steps), shape[: len(steps)]).reshape(shape[0], 1, -1)


def merge_moments(moments: np.ndarray) -> np.ndarray:
    """The moments of all m parts together, [5, components], from [m, 5, components]."""
    return np.concatenate([moments[:, :3].sum(0), moments[:, 3:4].min(0), moments[:, 4:].max(0)])


def pack_moments(moments: Mapping[str, np.ndarray]) -> np.ndarray:
    """The moments [5, components] of all fields as one float64 vector, in the order of their names."""
    parts = [moments[name].reshape(-1) for name in sorted(moments)]
    return np.concatenate(parts) if parts else np.zeros(0)


def summarize(rows: np.ndarray, fields: Mapping[str, Field]) -> Stats:
    """Mean, standard deviation, minimum and maximum of each field, from m vectors that `pack_moments` returned."""
    stats, begin = {}, 0
    for name, components in component_counts(fields).items():
        end = begin + MOMENTS * components
        count, total, squares, low, high = merge_moments(rows[:, begin:end].reshape(-1, MOMENTS, components))
        with np.errstate(all="ignore"):
            mean = total / count
            std = np.sqrt(np.maximum(squares / count - mean**2, 0))
        # JSON has no NaN or infinity: None.
        values = {"mean": mean, "std": std, "min": low, "max": high}
        stats[name] = {key: value.tolist() if np.isfinite(value).all() else None for key, value in values.items()}
        begin = end
    return stats
