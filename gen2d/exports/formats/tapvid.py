"""TAP-Vid: pickles SPLIT-000000.pkl, ... of dictionaries, as its readers load them.

Each pickle maps the key of a video to `video` [T, H, W, 3] uint8, `points` [N, T, 2] float32 (x, y over the width and
the height, from corner to corner) and `occluded` [N, T] bool. Points that are never seen are left out. A pickle runs
code when it is loaded: load only those that you trust.
"""

import pickle
from pathlib import Path

import numpy as np

from gen2d.plugin import Batch, Export, Source

FILE_BYTES, FILE_VIDEOS = 2**28, 100  # maximum of a pickle, which holds one video at least


def part_videos(source: Source) -> int:
    """Number of videos in a pickle."""
    return max(1, min(FILE_VIDEOS, FILE_BYTES // source.video_bytes))


def write(target: Path, source: Source) -> None:
    """Write SPLIT-000000.pkl, or another pickle of these videos."""
    height, width = source.frame_size
    content = {}
    for index, video in zip(source.numbers, source.videos(), strict=True):
        content[source.key(index)] = tracks(video, height, width)
        source.advance(1)
    path = target / f"{source.ds.options.split}-{source.places.start // part_videos(source):06d}.pkl"
    path.write_bytes(pickle.dumps(content, protocol=4))


def tracks(video: Batch, height: int, width: int) -> dict[str, np.ndarray]:
    """TAP-Vid's arrays of a video."""
    seen = (video["tracks/object"] >= 0) & video["tracks/visible"].any(0)
    points = video["tracks/points"][:, seen] / np.array([width, height], np.float32)
    occluded = ~video["tracks/visible"][:, seen]
    by_point = np.ascontiguousarray(points.transpose(1, 0, 2)), np.ascontiguousarray(occluded.T)
    return {"video": np.ascontiguousarray(video["frames"]), "points": by_point[0], "occluded": by_point[1]}


EXPORT = Export(
    fields=("frames", "tracks/points", "tracks/visible", "tracks/object"),
    write=write,
    separate=True,
    part_videos=part_videos,
    fixed=True,
    loss="frames and tracks alone",
)
