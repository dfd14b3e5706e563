"""Pictures for a person: a contact sheet (videos down, time across) and an animation, of a dataset or of a config."""

import contextlib
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from gen2d.core.errors import FolderError, UserError
from gen2d.loading.dataset import Dataset
from gen2d.loading.dataset import open as open_dataset
from gen2d.storage.atomic import publish
from gen2d.storage.paths import Url, place

COLUMNS = 10  # frames across the sheet
LARGEST = 192  # px: of a frame on a dataset's card
GAP, GREY = 2, 170  # px between pictures, and its sRGB
SMALLEST = 96  # px: smaller frames are enlarged by whole factors, so that pixels stay pixels


def preview(
    source: str,
    out: Path,
    videos: int = 8,
    *,
    seed: int | None = None,
    sets: Sequence[str] = (),
    trust: Sequence[str] = (),
    timeout: float = 30.0,
    deadline: float = 300.0,
) -> list[Path]:
    """The files made in the folder `out`: NAME-sheet.png and NAME.gif. `trust` is that of `render`, for a dataset
    without frames; `timeout` and `deadline` are those of `open`."""
    check_videos(videos)
    check_folder(out)
    if is_dataset(source):
        ds = open_dataset(source, timeout=timeout, deadline=deadline)
        numbers = range(min(videos, len(ds)))
        name, frames, fps = ds.manifest.name, _stored(ds, numbers, trust), ds.manifest.fps
    else:
        name, frames, fps = _drawn(source, videos, seed, sets)
    sheet, animation = out / f"{name}-sheet.png", out / f"{name}.gif"
    with writing(out):
        write(sheet, contact_sheet(frames))
        animate(animation, frames, fps)
    return [sheet, animation]


def is_dataset(source: str) -> bool:
    """Whether it is a dataset, at a URL or in a folder, that is to be drawn; all else is a config."""
    found = place(source)
    return isinstance(found, Url) or found.is_dir()


def check_videos(videos: int) -> None:
    """Returns nothing; raises UserError where there would be no video."""
    if videos < 1:
        raise UserError(f"--videos is {videos}, but must be 1 or more")


def check_folder(out: Path) -> None:
    """Returns nothing; makes the folder for pictures, or raises FolderError, before any is drawn."""
    with writing(out), tempfile.TemporaryFile(dir=out):
        pass


@contextlib.contextmanager
def writing(out: Path) -> Iterator[None]:
    """A block that writes into a folder, which is made first; its OSError becomes a FolderError."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        yield
    except OSError as error:
        raise FolderError(f"{out}: pictures cannot be written there ({error.strerror or error})") from None


def _stored(ds: Dataset, numbers: Sequence[int], trust: Sequence[str]) -> np.ndarray:
    """The frames of a dataset's videos, drawn again where they are not stored."""
    if "frames" in ds.manifest.fields:
        return ds.batch(numbers)["frames"]
    from gen2d.redraw import render

    return np.asarray(render(ds, numbers, trust=trust))


def _drawn(source: str, videos: int, seed: int | None, sets: Sequence[str]) -> tuple[str, np.ndarray, float]:
    """Name, frames and frame rate of a config's first videos, made but not stored."""
    import dataclasses

    from gen2d import devices
    from gen2d.config import checked_seed, load_config
    from gen2d.pipeline import check_placed
    from gen2d.rollout import Rollout, parts

    config = load_config(source, [*sets, "storage.frames=video"])
    if seed is not None:
        config = dataclasses.replace(config, seed=checked_seed(seed))
    split = config.training.name if config.training else "train"
    frames = []
    with contextlib.closing(Rollout(config.of_split(split), devices.prepare()[:1])) as rollout:
        for first in range(0, videos, rollout.lanes):
            batch = rollout.begin(split, [first])
            placed = parts(batch.placed)[0][: videos - first]
            check_placed(config.scene, placed, np.arange(first, first + len(placed)))
            for start in range(0, min(rollout.lanes, videos - first), rollout.slice):
                frames.append(np.asarray(rollout.draw(batch, start, rollout.slice)[0]["frames"]))
    return config.name, np.concatenate(frames)[:videos], config.video.fps


def shown(frames: int) -> np.ndarray:
    """The numbers of the frames that a sheet shows, the first and the last among them."""
    return np.unique(np.linspace(0, frames - 1, COLUMNS).round().astype(int))


def contact_sheet(frames: np.ndarray) -> np.ndarray:
    """One picture [H, W, 3]: a row for each of the videos [n, T, H, W, 3], first to last frame from left to right."""
    rows = [np.concatenate([_framed(video[t]) for t in shown(len(video))], axis=1) for video in frames]
    return np.concatenate(rows)


def reduced(video: np.ndarray) -> np.ndarray:
    """The frames of a video [T, H, W, 3] that a sheet shows, larger ones averaged down."""
    frames = video[shown(len(video))]
    factor = -(-max(frames.shape[1:3]) // LARGEST)
    if factor == 1:
        return frames
    size = frames.shape[2] // factor, frames.shape[1] // factor
    return np.stack([cv2.resize(frame, size, interpolation=cv2.INTER_AREA) for frame in frames])


def enlarged(image: np.ndarray) -> np.ndarray:
    """A small image [H, W] or [H, W, 3] larger by a whole factor."""
    factor = -(-SMALLEST // min(image.shape[:2]))
    return np.repeat(np.repeat(image, factor, axis=0), factor, axis=1)


def _framed(frame: np.ndarray) -> np.ndarray:
    return np.pad(enlarged(frame), [(GAP, GAP), (GAP, GAP), (0, 0)], constant_values=GREY)


def animate(path: Path, frames: np.ndarray, fps: float) -> None:
    """Writes all videos side by side as an animated GIF that loops."""
    across = int(np.ceil(np.sqrt(len(frames))))
    blank = np.zeros_like(frames[0])
    cells = [*frames, *[blank] * (-len(frames) % across)]
    rows = [np.concatenate([_tiled(v) for v in cells[i : i + across]], axis=2) for i in range(0, len(cells), across)]
    movie = cv2.Animation()
    movie.frames = [image[..., ::-1].copy() for image in np.concatenate(rows, axis=1)]
    movie.durations = [max(20, round(1000 / fps))] * len(movie.frames)
    done, content = cv2.imencodeanimation(".gif", movie)
    if not done:
        raise OSError("OpenCV could not make a GIF")
    publish(path, content.tobytes())


def _tiled(video: np.ndarray) -> np.ndarray:
    return np.stack([_framed(frame) for frame in video])


def write(path: Path, image: np.ndarray) -> None:
    """Writes a picture [H, W, 3]."""
    publish(path, png(image))


def png(image: np.ndarray) -> bytes:
    """A picture [H, W, 3] as the bytes of a PNG file."""
    done, content = cv2.imencode(".png", image[..., ::-1])
    if not done:
        raise OSError("OpenCV could not write a PNG")
    return content.tobytes()
