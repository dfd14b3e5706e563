"""Tar files of whole videos, as WebDataset reads them: KEY.frames.npy, KEY.states.position.npy, ... and KEY.json;
text is KEY.text.caption.txt and KEY.text.events.json.

A key is followed by a dot and the field's name, whose slashes become dots, as a key's files must lie in one folder.
"""

import dataclasses
import io
import tarfile
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from gen2d.plugin import Batch, Export, Source, as_json

TAR_BYTES, TAR_VIDEOS = 2**28, 1000  # a tar file holds so much at most, but at least one video


def write(target: Path, source: Source) -> None:
    """Fills the folder with SPLIT-000000.tar and so on, equal bytes for equal datasets."""
    videos = enumerate(source.videos())
    each = max(1, min(TAR_VIDEOS, TAR_BYTES // source.video_bytes))
    for number in range(-(-len(source) // each)):
        with tarfile.open(target / f"{source.ds.options.split}-{number:06d}.tar", "w") as tar:
            for index, video in islice(videos, each):
                _add_video(tar, source, index, video)
                source.advance(1)


def _add_video(tar: tarfile.TarFile, source: Source, number: int, video: Batch) -> None:
    key = source.key(number)
    _add(tar, f"{key}.json", as_json(_about(source, number)))
    for name, values in video.items():
        field, path = source.fields[name], f"{key}.{name.replace('/', '.')}"
        if field.is_text:
            _add(tar, f"{path}.{'json' if field.unit == 'JSON' else 'txt'}", bytes(values))
        else:
            file = io.BytesIO()
            np.save(file, values, allow_pickle=False)
            _add(tar, f"{path}.npy", file.getvalue())


def _about(source: Source, number: int) -> dict[str, Any]:
    """What a video's JSON says: where it comes from, and what each field is."""
    about = {key: source.ds.manifest.plain[key] for key in ("name", "seed", "fps")}
    fields = {name: dataclasses.asdict(field) for name, field in source.fields.items()}
    return about | {"split": source.ds.options.split, "number": number, "fields": fields}


def _add(tar: tarfile.TarFile, name: str, content: bytes) -> None:
    """Adds a file without time and owner."""
    about = tarfile.TarInfo(name)  # whose times and owners are 0
    about.size = len(content)
    tar.addfile(about, io.BytesIO(content))


EXPORT = Export(fields=("frames", "*"), write=write)
