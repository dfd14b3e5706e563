"""Contact sheet (videos down, time across) and animation of a dataset or a config."""

import contextlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gen2d.core.errors import UserError
from gen2d.loading.dataset import Dataset
from gen2d.loading.dataset import open as open_dataset
from gen2d.media.contact_sheet import contact_sheet
from gen2d.media.images import animate, check_folder, write, writing
from gen2d.storage.paths import Url, place


def preview(
    source: str | Path | Url,
    out: str | Path = ".",
    videos: int = 8,
    *,
    seed: int | None = None,
    overrides: Sequence[str] = (),
    trust: Sequence[str] = (),
    timeout: float = 30.0,
    deadline: float = 300.0,
) -> list[Path]:
    """Paths of a contact sheet, NAME-sheet.png, and an animation, NAME.webp, written into the folder `out`.

    `source` is a dataset's folder or URL, or a config, which `seed` and `overrides` change. `trust` is that of
    `render`, for a dataset without frames; `timeout` and `deadline`, in seconds, are those of `open`.
    Raises UserError for an invalid source or option, DamagedError, UnreachableError.
    """
    source, out = str(source) if isinstance(source, Path) else source, Path(out)
    check_videos(videos)
    check_folder(out)
    if is_dataset(source):
        ds = open_dataset(source, timeout=timeout, deadline=deadline)
        numbers = range(min(videos, len(ds)))
        name, frames, fps = ds.manifest.name, _stored(ds, numbers, trust), ds.manifest.fps
    else:
        name, frames, fps = _drawn(str(source), videos, seed, overrides)
    sheet, animation = out / f"{name}-sheet.png", out / f"{name}.webp"
    with writing(out):
        write(sheet, contact_sheet(frames))
        animate(animation, frames, fps)
    return [sheet, animation]


def is_dataset(source: str | Url) -> bool:
    """Whether the source is a dataset, at a URL or in a folder, rather than a config."""
    path = place(source)
    return isinstance(path, Url) or path.is_dir()


def check_videos(videos: int) -> None:
    """Raise UserError unless `videos` is positive."""
    if videos < 1:
        raise UserError(f"--videos is {videos}, but must be 1 or more")


def _stored(ds: Dataset, numbers: Sequence[int], trust: Sequence[str]) -> np.ndarray:
    """Frames of a dataset's videos, rendered if they are not stored."""
    if "frames" in ds.manifest.fields:
        return ds.batch(numbers)["frames"]
    from gen2d.programs.redraw import render

    return np.asarray(render(ds, numbers, trust=trust))


def _drawn(source: str, videos: int, seed: int | None, overrides: Sequence[str]) -> tuple[str, np.ndarray, float]:
    """Name of a config, and the frames and frame rate of its first videos."""
    import dataclasses

    from gen2d.config.config import checked_seed, load_config
    from gen2d.programs import devices
    from gen2d.programs.source import VideoSource

    config = load_config(source, [*overrides, "storage.frames=video"])
    if seed is not None:
        config = dataclasses.replace(config, seed=checked_seed(seed))
    split = config.training.name if config.training else "train"
    with contextlib.closing(VideoSource(config.of_split(split), devices.prepare()[:1])) as videos_of:
        frames = videos_of.videos(split, range(videos), ("frames",))["frames"]
    return config.name, frames, config.video.fps
