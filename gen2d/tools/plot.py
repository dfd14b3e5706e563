"""Plots of a dataset as PNG and SVG: one video's motion and accounts, and the distributions of the factors."""

import io
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gen2d.core.enums import BEGIN, IMPACT, STATIC
from gen2d.core.errors import UserError, argument
from gen2d.core.progress import waiting
from gen2d.dataset.manifest import read_manifest
from gen2d.loading.dataset import Dataset
from gen2d.loading.dataset import open as open_dataset
from gen2d.media.images import check_folder, writing
from gen2d.page.video import Videos, energies
from gen2d.storage.atomic import publish
from gen2d.storage.paths import Url, place
from gen2d.storage.retries import Network
from gen2d.tools.preview import folder_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COUNTED = 5000  # videos of each split in a histogram
MAX_PANELS = 24
BINS = 40
COLORS = ("#00798c", "#d1495b", "#edae49", "#8d6a9f", "#66a182", "#30638e", "#e07a5f", "#3d405b")


def plot(
    source: str | Path | Url,
    out: str | Path = ".",
    video: int = 0,
    *,
    split: str | None = None,
    timeout: float = 30.0,
    deadline: float = 300.0,
) -> list[Path]:
    """Write plots of one video, NAME-SPLIT-I.png, and of the factors, NAME-factors.png, each also as SVG.

    The first shows trajectories, energy, momentum and contacts, as far as the dataset holds them. The second shows the
    histogram of each factor in each split, with the density that the config asks for where it is a simple one.

    Parameters
    ----------
    source : str or path
        Folder or URL of a dataset.
    out : str or Path
        Folder for the files.
    video : int
        Number of the video in its split.
    split : str, optional
        Name of the split. The default is "train", or the only split.
    timeout : float
        Limit in s of a server's silence, as in `open`.
    deadline : float
        Limit in s of a whole request, as in `open`.

    Returns
    -------
    list of Path
        Paths of the files; those of the factors only if the dataset has factors that vary.

    Raises
    ------
    UserError
        If the source or an option is invalid, or if matplotlib is not installed.
    DamagedError
        If a stored field cannot be read.
    UnreachableError
        If a server does not answer.

    Examples
    --------
    >>> files = gen2d.plot("datasets/bouncing", "pictures", video=3)
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise UserError("plots need matplotlib: pip install 'gen2d[plot]'") from None
    out, root = Path(out), place(source if isinstance(source, Url) else str(source), Network(timeout, deadline))
    ds = open_dataset(root, split, ["index"])
    if not 0 <= video < len(ds):
        raise UserError(f"{argument('video')} is {video}, but must be from 0 to {len(ds) - 1} for {ds.options.split}")
    check_folder(out)
    name = folder_name(root, ds.manifest)
    with waiting(f"Plotting video {video} of {ds.options.split}"):
        figure = Figure(figsize=(11, 8), layout="constrained")
        figure.suptitle(f"{name}: video {video} of {ds.options.split}")
        _plot_video(figure, ds, video)
        files = _written(figure, out, f"{name}-{ds.options.split}-{video}")
        factors = list(_factors(root, ds))[:MAX_PANELS]
        if factors:
            rows = -(-len(factors) // 4)
            figure = Figure(figsize=(13, 2.6 * rows + 0.4), layout="constrained")
            figure.suptitle(f"{name}: factors")
            grid = figure.subplots(rows, 4, squeeze=False).ravel()
            for axes, (title, asked, values) in zip(grid, factors, strict=False):
                _plot_factor(axes, title, asked, values)
            for axes in grid[len(factors) :]:
                axes.set_axis_off()
            files += _written(figure, out, f"{name}-factors")
    return files


def _written(figure: "Figure", out: Path, name: str) -> list[Path]:
    """Write a figure as PNG and SVG; the same figure gives the same bytes."""
    import matplotlib

    paths = []
    with writing(out), matplotlib.rc_context({"svg.hashsalt": "gen2d"}):
        for kind, metadata in (("png", {"Software": None}), ("svg", {"Date": None, "Creator": None})):
            content = io.BytesIO()
            figure.savefig(content, format=kind, dpi=110, metadata=metadata)
            paths.append(out / f"{name}.{kind}")
            publish(paths[-1], content.getvalue())
    return paths


def _plot_video(figure: "Figure", ds: Dataset, number: int) -> None:
    """Panels of a video, as far as its fields allow."""
    videos = Videos(ds.root, ds.manifest, ds.options.split)
    values, times = videos.dataset[number], ds.time
    curves = energies(values)
    grid = figure.subplots(2, 2).ravel()
    _plot_trajectories(grid[0], values)
    for color, (name, series) in enumerate((n, s) for n, s in curves.items() if n.startswith("energy/")):
        grid[1].plot(times, series, label=name[7:].replace("_", " "), color=COLORS[color % len(COLORS)])
    _finish(grid[1], "Energy", "time (s)", "energy (J)")
    momentum = curves.get("momentum/linear", np.zeros((0, 2)))
    for axis, series in zip("xy", momentum.T, strict=True):
        if len(series):
            grid[2].plot(times, series, label=axis, color=COLORS["xy".index(axis)])
    _finish(grid[2], "Momentum of all dynamic objects", "time (s)", "momentum (kg m/s)")
    if "contacts/normal_impulse" in values and "contacts/kind" in values:
        begins = np.isin(values["contacts/kind"], (IMPACT, BEGIN)) & (values["contacts/frame"] < len(times))
        frames = np.minimum(values["contacts/frame"][begins], len(times) - 1)
        if begins.any():
            stems = grid[3].stem(times[frames], np.abs(values["contacts/normal_impulse"][begins]), label="begins")
            stems.stemlines.set_color(COLORS[0])
            stems.markerline.set(color=COLORS[0], markersize=4)
            stems.baseline.set_color("#999999")
    _finish(grid[3], "Contacts", "time (s)", "impulse (N s)")


def _plot_trajectories(axes: "Axes", values: Mapping[str, np.ndarray]) -> None:
    """Paths of the centres of the objects that move, each in its colour; a dot marks the start."""
    if "states/position" in values:
        kinds = values.get("objects/kind", np.zeros(len(values["objects/present"])))
        for slot in np.flatnonzero(values["objects/present"] & (kinds != STATIC)):
            color = values["objects/color"][slot] / 255 if "objects/color" in values else COLORS[slot % len(COLORS)]
            x, y = values["states/position"][:, slot].T
            axes.plot(x, y, color=color, linewidth=1.6)
            axes.plot(x[:1], y[:1], "o", color=color, markersize=5)
            axes.annotate(str(slot), (x[0], y[0]), textcoords="offset points", xytext=(4, 4), fontsize=8)
        axes.set_aspect("equal", "datalim")
    _finish(axes, "Trajectories, from the dot on", "x (m)", "y (m)")


def _finish(axes: "Axes", title: str, x: str, y: str) -> None:
    """Add title and labels to a panel, and a legend if its curves have names."""
    axes.set(title=title, xlabel=x, ylabel=y)
    axes.grid(alpha=0.3)
    if not axes.has_data():
        axes.text(0.5, 0.5, "not stored", transform=axes.transAxes, ha="center", color="#777777")
    elif axes.get_legend_handles_labels()[1]:
        axes.legend(fontsize=8)


# ---- Factors


def _factors(root: Any, ds: Dataset) -> Iterator[tuple[str, Any, dict[str, np.ndarray]]]:
    """Title, distribution in the config, and values by split of every factor, or component of one, that varies."""
    manifest = read_manifest(root)
    scene = manifest.config.get("scene")
    fields = {name: field for name, field in manifest.fields.items() if name.startswith("factors/")}
    fields = {name: field for name, field in fields.items() if not {*field.axes.split()} & {*"TKHW"}}
    batches = {}
    for split in manifest.splits if fields else ():
        opened = open_dataset(root, split, list(fields))
        batches[split] = opened.batch(range(min(COUNTED, len(opened))))
    for name, field in fields.items():
        key = name.removeprefix("factors/")
        asked = scene.get(key) if isinstance(scene, dict) else None
        per_object = len(field.axes.split()) > 1 and f"factors/{field.axes.split()[1]}" in fields
        for component in _components(field.shape(manifest.sizes)[1 if per_object else 0 :]):
            values = {}
            for split, batch in batches.items():
                own = batch[name].astype(np.float64)
                if per_object:  # only the objects that a video has
                    counts = batch[f"factors/{field.axes.split()[1]}"].reshape(-1, 1)
                    own = own[np.arange(own.shape[1]) < counts]
                own = own[(slice(None), *component)].ravel()
                values[split] = own[np.isfinite(own)]
            everything = np.concatenate([*values.values()])
            if not len(everything) or everything.min() == everything.max():
                continue
            label = f"{key}{list(component) if component else ''}"
            own_asked = asked
            for place_ in component:
                own_asked = own_asked[place_] if isinstance(own_asked, list) and len(own_asked) > place_ else None
            yield f"{label} ({field.unit})" if field.unit not in ("", "1", key) else label, own_asked, values


def _components(shape: tuple[int, ...]) -> list[tuple[int, ...]]:
    """Indices of the components of a factor, at most eight."""
    return [tuple(map(int, index)) for index in np.ndindex(*shape)][:8]


def _plot_factor(axes: "Axes", title: str, asked: Any, values: Mapping[str, np.ndarray]) -> None:
    """Histograms of a factor by split, with the density that the config asks for."""
    everything = np.concatenate([*values.values()])
    low, high = everything.min(), everything.max()
    whole = bool((everything == np.floor(everything)).all()) and high - low < BINS
    bins = min(BINS, max(8, round(len(everything) ** 0.5)))
    edges = np.arange(low - 0.5, high + 1) if whole else np.linspace(low, high, bins + 1)
    for color, (split, own) in enumerate(values.items()):
        if len(own):
            weights = np.full(len(own), 1 / len(own) / np.diff(edges)[0])
            own_color, kind = COLORS[color % len(COLORS)], "step" if len(values) > 1 else "stepfilled"
            axes.hist(own, edges, weights=weights, label=split, color=own_color, histtype=kind, linewidth=1.6)
    x = np.arange(low, high + 1) if whole else np.linspace(low, high, 200)
    density = _density(asked, x, whole)
    if density is not None:
        axes.plot(x, density, "." if whole else "-", color="#222222", linewidth=1.2, label="scene in the config")
    axes.set_title(title, fontsize=9)
    axes.tick_params(labelsize=8)
    axes.set_yticks([])
    if len(values) > 1 or density is not None:
        axes.legend(fontsize=7)


def _density(asked: Any, x: np.ndarray, whole: bool) -> np.ndarray | None:
    """Density at x of a simple distribution of a config; None for another."""
    if not (isinstance(asked, dict) and len(asked) == 1):
        return None
    (kind, numbers), *_ = asked.items()
    is_plain = isinstance(numbers, list) and all(isinstance(n, int | float) for n in numbers) and len(numbers) >= 2
    if not is_plain:
        return None
    first, last = float(numbers[0]), float(numbers[1])
    inside = (x >= first) & (x <= last)
    if kind == "uniform" and last > first and not whole:
        return np.where(inside, 1 / (last - first), 0)
    if kind == "integer" and whole:
        return np.where(inside, 1 / (last - first + 1), 0)
    if kind == "log_uniform" and last > first > 0 and not whole:
        return np.where(inside, 1 / (np.maximum(x, first) * math.log(last / first)), 0)
    if kind == "normal" and last > 0 and len(numbers) == 2 and not whole:
        return np.exp(-(((x - first) / last) ** 2) / 2) / (last * math.sqrt(2 * math.pi))
    if kind == "choice" and whole:
        return np.array([sum(n == value for n in numbers) / len(numbers) for value in x])
    return None
