"""Files that several formats write: NumPy archives, films with archives beside them, and images of every frame."""

import io
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from gen2d.core.errors import ConfigError, argument
from gen2d.exports.source import Source
from gen2d.loading.protocols import Batch
from gen2d.media import images
from gen2d.media.films import Codec


def archive(video: Batch) -> bytes:
    """Content of a compressed NumPy archive (npz) with these arrays; equal arrays give equal bytes."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as entries:
        for name, values in video.items():
            entry = zipfile.ZipInfo(f"{name}.npy")  # of 1980
            entry.compress_type = zipfile.ZIP_DEFLATED
            with entries.open(entry, "w", force_zip64=values.nbytes >= 2**31) as target:
                np.lib.format.write_array(target, np.asanyarray(values), allow_pickle=False)
    return file.getvalue()


def write_films(target: Path, source: Source, codec: Codec) -> None:
    """Write a film for each video to the folder, and KEY.npz with its other fields, and `time`, if there are any."""

    def write_film(key: str, video: Batch) -> None:
        codec.write(target / f"{key}{codec.suffix}", video["frames"], source.fps)
        others = without_frames(video)
        if others:
            (target / f"{key}.npz").write_bytes(archive({**others, "time": source.ds.time}))

    source.each(write_film)


def write_images(
    target: Path, source: Source, folder: str, field: str, encode: Callable[[np.ndarray], np.ndarray]
) -> None:
    """Write images/KEY-0000.png of each frame, and FOLDER/KEY-0000.png of `encode(values)` of a field of the frame."""
    for name in ("images", folder):
        (target / name).mkdir()

    def write_video(key: str, video: Batch) -> None:
        for frame, (image, values) in enumerate(zip(video["frames"], video[field], strict=True)):
            name = f"{key}-{frame:04d}.png"
            (target / "images" / name).write_bytes(images.png(image))
            (target / folder / name).write_bytes(images.png(encode(values)))

    source.each(write_video)


def check_films(source: Source, name: str, codec: Codec) -> None:
    """Raise ConfigError for unsupported frame sizes and rates, or if frames are left out, UserError without PyAV."""
    check_frames(source, name)
    codec.check(name, source.frame_size, source.fps)


def check_frames(source: Source, name: str) -> None:
    """Raise ConfigError if the frames are left out."""
    if "frames" not in source.fields:
        raise ConfigError(f"{argument('fields')} is {' '.join(source.fields)}, but must contain frames for {name}")


def check_undistorted(source: Source, name: str) -> None:
    """Raise ConfigError for frames with lens distortion, which `name` would describe wrongly."""
    if "image/distortion" in source.ds.manifest.fields:
        raise ConfigError(
            f"{source.ds.root}: frames are distorted (image.distortion), but {name} holds places without distortion"
        )


def notes(source: Source, name: str) -> Iterator[tuple[int, str]]:
    """Lines of the notes NAME-PLACE of all parts, in their order, with their numbers from 1 on."""
    paths = sorted(source.notes.glob(f"{name}-*"))
    lines = (line.removesuffix("\n") for path in paths for line in path.read_text().splitlines(keepends=True))
    return enumerate(lines, 1)


def without_frames(video: Batch) -> Batch:
    """The fields of a video but for its frames."""
    return {name: values for name, values in video.items() if name != "frames"}
