"""One HDF5 file in the format of the study 'How Far is Video Generation from World Model' (phyworld): one or two balls.

The groups `video_streams`, `position_streams` and `init_streams` hold datasets 00000, 00001, ... of 1000 videos each:
films as bytes (MPEG-4, as from `--to mp4`); positions [n, T, 2], or [n, T, 2, 2] for two balls; and initial values,
[r, v] or [r1, r2, v1, v2], with radii and with speeds at the first frame. Lengths are in tenths of the frame's width;
the origin is the lower left corner, y up. Balls are in the order of their slots. Static bodies appear in the films, but
not in the positions.
"""

import tempfile
from itertools import islice
from pathlib import Path

import h5py
import numpy as np

from gen2d.plugin import CIRCLE, STATIC, Batch, ConfigError, Export, Source, films
from gen2d.plugin import dataset as loader

CAMERA = ("camera/center", "camera/scale", "camera/angle")
OBJECTS = ("objects/present", "objects/kind", "objects/shape")
UNITS = 10.0  # width of the frame, in units of the file
GROUP = 1000  # videos in an HDF5 dataset


def check(source: Source) -> None:
    """Raise ConfigError for unsupported sizes, rates and videos, and UserError without PyAV.

    Each video must have one or two moving balls, as many as the first one, and a camera that is upright and at rest.
    """
    films.CODECS["mp4v"].check("phyworld", source.frame_size, source.fps)
    ds = loader.open(source.ds.root, source.ds.options.split, (*OBJECTS, *CAMERA))
    count = len(_balls(ds[0]))
    for number in range(len(ds)):
        problem = _problem_of(ds[number], count)
        if problem:
            raise ConfigError(f"phyworld cannot hold {ds.options.split} video {number} of {ds.root}: {problem}")


def write(target: Path, source: Source) -> None:
    """Write the HDF5 file."""
    videos = source.videos()
    with h5py.File(target, "w", locking=False) as file, tempfile.TemporaryDirectory() as folder:
        for first in range(0, len(source), GROUP):
            name, count = f"{first // GROUP:05d}", min(GROUP, len(source) - first)
            films_dataset = file.create_dataset(f"video_streams/{name}", (count,), h5py.vlen_dtype(np.uint8))
            positions, inits = [], []
            for row, video in enumerate(islice(videos, count)):
                films_dataset[row] = _film(Path(folder) / "film.mp4", video, source.fps)
                position, init = _motion(video, source.frame_size)
                positions.append(position)
                inits.append(init)
                source.advance(1)
            file[f"position_streams/{name}"] = np.stack(positions)
            file[f"init_streams/{name}"] = np.stack(inits)


def _balls(video: Batch) -> np.ndarray:
    """Slots of the bodies that are not static."""
    return np.flatnonzero(video["objects/present"] & (video["objects/kind"] != STATIC))


def _problem_of(video: Batch, count: int) -> str:
    """Reason why the format cannot represent a video, or ""; `count` is the number of balls in the first video."""
    balls = _balls(video)
    if (video["objects/shape"][balls] != CIRCLE).any():
        return "something else than a ball moves in it"
    if len(balls) not in (1, 2) or len(balls) != count:
        allowed = count if count in (1, 2) else "1 or 2"
        return f"the number of balls that move in it is {len(balls)}, but must be {allowed}"
    if video["camera/angle"].any() or any(np.ptp(video[name], axis=0).any() for name in CAMERA):
        return "its camera moves or is turned, but must stand still and upright"
    return ""


def _film(path: Path, video: Batch, fps: float) -> np.ndarray:
    films.CODECS["mp4v"].write(path, video["frames"], fps)
    return np.frombuffer(path.read_bytes(), np.uint8)


def _motion(video: Batch, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Positions [T, 2] or [T, 2, 2], and initial values [r, v] or [r1, r2, v1, v2], in units of the file."""
    balls, (height, width) = _balls(video), size
    pixel = UNITS / width
    metre = float(video["camera/scale"][0]) * pixel
    from_center = video["states/position"][:, balls].astype(np.float64) - video["camera/center"][0]
    position = from_center * metre + np.array([width, height]) / 2 * pixel
    speed = np.linalg.norm(video["states/velocity"][0, balls].astype(np.float64), axis=-1)
    init = np.concatenate([video["objects/radius"][balls], speed]) * metre
    return (position[:, 0] if len(balls) == 1 else position), init


EXPORT = Export(
    fields=("frames", "states/position", "states/velocity", "objects/radius", *OBJECTS, *CAMERA),
    write=write,
    check=check,
    fixed=True,
    suffix=".hdf5",
    loss=f"{films.LOSS}; positions and first speeds of the balls alone",
)
