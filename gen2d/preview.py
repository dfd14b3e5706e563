"""Pictures for a person: a contact sheet (videos down, time across) and an animation, of a dataset or of a config."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from gen2d.errors import FolderError, UserError
from gen2d.loader import open as open_dataset

COLUMNS = 10  # frames across the sheet
GAP = 2  # px between pictures
SMALLEST = 96  # px: smaller frames are enlarged by whole factors, so that pixels stay pixels


def preview(
    source: str, out: Path, videos: int = 8, *, seed: int | None = None, sets: Sequence[str] = ()
) -> list[Path]:
    """The files made in the folder `out`: NAME-sheet.png and NAME.gif."""
    if videos < 1:
        raise UserError(f"--videos is {videos}, but must be 1 or more")
    if Path(source).is_dir():
        ds = open_dataset(source, fields=("frames",))
        name, frames, fps = ds.manifest["name"], ds.batch(range(min(videos, len(ds))))["frames"], ds.manifest["fps"]
    else:
        name, frames, fps = _drawn(source, videos, seed, sets)
    try:
        out.mkdir(parents=True, exist_ok=True)
        sheet, animation = out / f"{name}-sheet.png", out / f"{name}.gif"
        _write(sheet, contact_sheet(frames))
        animate(animation, frames, fps)
    except OSError as error:
        raise FolderError(f"{out}: pictures cannot be written there ({error.strerror or error})") from None
    return [sheet, animation]


def _drawn(source: str, videos: int, seed: int | None, sets: Sequence[str]) -> tuple[str, np.ndarray, float]:
    """Name, frames and frame rate of a config's first videos, made but not stored."""
    import dataclasses

    from gen2d import devices
    from gen2d.config import checked_seed, load_config
    from gen2d.pipeline import check_placed
    from gen2d.rollout import Rollout, parts

    config = load_config(source, sets)
    if seed is not None:
        config = dataclasses.replace(config, seed=checked_seed(seed))
    rollout = Rollout(config, devices.prepare()[:1])
    frames = []
    for first in range(0, videos, rollout.lanes):
        batch = rollout.begin("train", [first])
        check_placed(parts(batch.placed)[0][: videos - first], first)
        for start in range(0, min(rollout.lanes, videos - first), rollout.slice):
            frames.append(parts(rollout.draw(batch, start, rollout.slice))[0])
    return config.name, np.concatenate(frames)[:videos], config.video.fps


def contact_sheet(frames: np.ndarray) -> np.ndarray:
    """One picture [H, W, 3]: a row for each of the videos [n, T, H, W, 3], first to last frame from left to right."""
    times = np.unique(np.linspace(0, frames.shape[1] - 1, COLUMNS).round().astype(int))
    rows = [np.concatenate([_framed(video[t]) for t in times], axis=1) for video in frames]
    return np.concatenate(rows)


def _framed(frame: np.ndarray) -> np.ndarray:
    factor = -(-SMALLEST // min(frame.shape[:2]))
    large = np.repeat(np.repeat(frame, factor, axis=0), factor, axis=1)
    return np.pad(large, [(GAP, GAP), (GAP, GAP), (0, 0)], constant_values=255)


def animate(path: Path, frames: np.ndarray, fps: float) -> None:
    """Writes all videos side by side as an animated GIF that loops."""
    across = int(np.ceil(np.sqrt(len(frames))))
    blank = np.zeros_like(frames[0])
    cells = [*frames, *[blank] * (-len(frames) % across)]
    rows = [np.concatenate([_tiled(v) for v in cells[i : i + across]], axis=2) for i in range(0, len(cells), across)]
    movie = cv2.Animation()
    movie.frames = [image[..., ::-1].copy() for image in np.concatenate(rows, axis=1)]
    movie.durations = [max(20, round(1000 / fps))] * len(movie.frames)
    if not cv2.imwriteanimation(str(path), movie):
        raise OSError("OpenCV could not write a GIF")


def _tiled(video: np.ndarray) -> np.ndarray:
    return np.stack([_framed(frame) for frame in video])


def _write(path: Path, image: np.ndarray) -> None:
    if not cv2.imwrite(str(path), image[..., ::-1]):
        raise OSError("OpenCV could not write a PNG")
