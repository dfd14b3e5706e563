"""Contact sheet (videos down, time across) and animation of a dataset or a config."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gen2d.core.errors import UserError, argument
from gen2d.core.progress import waiting
from gen2d.dataset.manifest import Manifest
from gen2d.loading.dataset import Dataset
from gen2d.loading.dataset import open as open_dataset
from gen2d.media.contact_sheet import contact_sheet
from gen2d.media.images import animate, check_folder, write, writing
from gen2d.page.sheet import dataset_sheet, first_videos
from gen2d.storage.paths import Place, Url, place


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
    """Write a contact sheet, NAME-sheet.png, and an animation, NAME.webp, of a dataset or a config.

    A dataset's pictures have the name of its folder. The sheet of one with stored frames names its videos and what
    differs in matched sets, and shows masks, boxes and flow of the first video where they are stored.

    Parameters
    ----------
    source : str or path
        Folder or URL of a dataset, or the name or path of a config.
    out : str or Path
        Folder for the files.
    videos : int
        Number of videos, 1 or more, from the first on.
    seed : int, optional
        Seed of the videos of a config; by default that of the config.
    overrides : sequence of str
        Options of the config to change, such as 'video.height=128'.
    trust : sequence of str
        sha256 of code in the dataset that may run, as in `render`; only for datasets without frames.
    timeout : float
        Limit in s of a server's silence, as in `open`.
    deadline : float
        Limit in s of a whole request, as in `open`.

    Returns
    -------
    list of Path
        Paths of the contact sheet and the animation.

    Raises
    ------
    UserError
        If the source or an option is invalid.
    DamagedError
        If a stored field cannot be read.
    UnreachableError
        If a server does not answer.

    Examples
    --------
    >>> sheet, animation = gen2d.preview("bouncing.yaml", "pictures", videos=4)
    """
    source, out = str(source) if isinstance(source, Path) else source, Path(out)
    check_videos(videos)
    check_folder(out)
    if is_dataset(source):
        ds = open_dataset(source, timeout=timeout, deadline=deadline)
        numbers = first_videos(ds.manifest, ds.options.split, videos)
        name, frames, fps = folder_name(ds.root, ds.manifest), _dataset_frames(ds, numbers, trust), ds.manifest.fps
        if "frames" in ds.manifest.fields:
            picture = dataset_sheet(ds.root, ds.manifest, ds.options.split, numbers)
        else:
            picture = contact_sheet(frames)
    else:
        name, frames, fps = _config_frames(str(source), videos, seed, overrides)
        picture = contact_sheet(frames)
    sheet, animation = out / f"{name}-sheet.png", out / f"{name}.webp"
    with writing(out), waiting(f"Writing {sheet.name} and {animation.name}"):
        write(sheet, picture)
        animate(animation, frames, fps)
    return [sheet, animation]


def is_dataset(source: str | Url) -> bool:
    """Whether the source is a dataset (a URL or a folder) rather than a config."""
    path = place(source)
    return isinstance(path, Url) or path.is_dir()


def folder_name(root: Place, manifest: Manifest) -> str:
    """Name of a dataset's folder, after which its pictures are named."""
    name = str(root).rstrip("/").rpartition("/")[2] if isinstance(root, Url) else root.resolve().name
    return name or manifest.name


def check_videos(videos: int) -> None:
    """Raise UserError unless `videos` is positive."""
    if videos < 1:
        raise UserError(f"{argument('videos')} is {videos}, but must be 1 or more")


def _dataset_frames(ds: Dataset, numbers: Sequence[int], trust: Sequence[str]) -> np.ndarray:
    """Frames [n, T, H, W, 3] of a dataset's videos, rendered if they are not stored."""
    if "frames" in ds.manifest.fields:
        return ds.batch(numbers)["frames"]
    with waiting("Importing jax"):
        from gen2d.programs.redraw import render

    return np.asarray(render(ds, numbers, trust=trust))


def _config_frames(
    source: str, videos: int, seed: int | None, overrides: Sequence[str]
) -> tuple[str, np.ndarray, float]:
    """Name of a config, and frames [n, T, H, W, 3] and frame rate of its first videos."""
    import dataclasses

    with waiting("Importing jax"):
        from gen2d.config.config import checked_seed, load_config
        from gen2d.programs import devices
        from gen2d.programs.source import VideoSource

    config = load_config(source, [*overrides, "storage.frames=video"])
    if seed is not None:
        config = dataclasses.replace(config, seed=checked_seed(seed))
    split = config.training.name if config.training else "train"
    with waiting(f"Compiling the programs of {config.name} (up to a minute; kept for later runs), and running them"):
        videos_of = VideoSource(config.of_split(split), devices.prepare()[:1])
        frames = videos_of.videos(split, range(videos), ("frames",))["frames"]
    return config.name, frames, config.video.fps
