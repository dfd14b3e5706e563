"""Tar files for WebDataset, with KEY.json and a file per field of each video: KEY.frames.npy, KEY.states.position.npy.

Text fields are KEY.text.caption.txt and KEY.text.events.json. Slashes in field names become dots, because all files of
a key must be in one folder.
"""

import dataclasses
import io
import tarfile
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from gen2d.plugin import Batch, Export, Source, as_json

TAR_BYTES, TAR_VIDEOS = 2**28, 1000  # maximum of a tar file, which holds one video at least


def write(target: Path, source: Source) -> None:
    """Write SPLIT-000000.tar, SPLIT-000001.tar, ... to the folder; equal datasets give equal bytes."""
    videos = enumerate(source.videos())
    per_file = max(1, min(TAR_VIDEOS, TAR_BYTES // source.video_bytes))
    for number in range(-(-len(source) // per_file)):
        with tarfile.open(target / f"{source.ds.options.split}-{number:06d}.tar", "w") as tar:
            for index, video in islice(videos, per_file):
                _add_video(tar, source, index, video)
                source.advance(1)


def _add_video(tar: tarfile.TarFile, source: Source, number: int, video: Batch) -> None:
    key = source.key(number)
    _add(tar, f"{key}.json", as_json(_video_description(source, number)))
    for name, values in video.items():
        field, path = source.fields[name], f"{key}.{name.replace('/', '.')}"
        if field.is_text:
            _add(tar, f"{path}.{'json' if field.unit == 'JSON' else 'txt'}", bytes(values))
        else:
            file = io.BytesIO()
            np.save(file, values, allow_pickle=False)
            _add(tar, f"{path}.npy", file.getvalue())


def _video_description(source: Source, number: int) -> dict[str, Any]:
    """Contents of a video's JSON: its origin, and the dtype, axes, unit and meaning of each field."""
    origin = {key: source.ds.manifest.plain[key] for key in ("name", "seed", "fps")}
    fields = {name: dataclasses.asdict(field) for name, field in source.fields.items()}
    return origin | {"split": source.ds.options.split, "number": number, "fields": fields}


def _add(tar: tarfile.TarFile, name: str, content: bytes) -> None:
    """Add a file to the archive."""
    member = tarfile.TarInfo(name)  # time and owner are 0, so that equal contents give equal bytes
    member.size = len(content)
    tar.addfile(member, io.BytesIO(content))


EXPORT = Export(fields=("frames", "*"), write=write)
