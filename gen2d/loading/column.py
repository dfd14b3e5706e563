"""Conversion of one field from the chunks of a shard file to its array in a batch."""

import numpy as np

from gen2d.dataset.block import stored_bytes
from gen2d.dataset.manifest import Manifest

LAYOUTS = {"THWC": (0, 1, 2, 3), "TCHW": (0, 3, 1, 2), "CTHW": (3, 0, 1, 2)}


class Column:
    """Stored form of a field, and the window, layout and dtype in which it is read."""

    def __init__(self, name: str, manifest: Manifest, layout: str, window: int | None, stride: int, dtype: str) -> None:
        field = manifest.fields[name]
        self.name, self.field, self.is_image = name, field, field.is_image
        self.codec = manifest.codec_of(name)
        self.stored_shape = field.shape(manifest.sizes)
        self.size = stored_bytes(field, manifest.sizes)
        self.frames = manifest.chunk_frames if field.is_image else None  # frames in a chunk
        self.chunk_count = manifest.pieces if field.is_image else 1
        axes = field.axes.split()[1:]
        self.order = LAYOUTS[layout] if self.is_image and len(axes) == 4 else tuple(range(len(axes)))
        self.window, self.stride = (window if axes[:1] == ["T"] else None), stride
        self.to_float = name == "frames" and dtype == "float32"
        self.dtype = np.dtype("float32" if self.to_float else field.dtype)
        shape = self.stored_shape if self.window is None else (self.window, *self.stored_shape[1:])
        self.shape = tuple(shape[axis] for axis in self.order)
        # The chunks of a direct column are read or decoded in the batch itself.
        self.is_direct = not self.to_float and self.window is None and self.order == tuple(range(len(axes)))

    def chunk_range(self, first: int) -> range:
        """Numbers of the chunks that hold the window beginning at frame `first`."""
        if self.window is None or self.frames is None:
            return range(self.chunk_count)
        return range(first // self.frames, (first + (self.window - 1) * self.stride) // self.frames + 1)

    def chunk_view(self, video: np.ndarray, number: int) -> np.ndarray:
        """View of chunk number `number` in the array `video` [1, T, ...] of a complete video."""
        return video if self.frames is None else video[:, number * self.frames : (number + 1) * self.frames]

    def convert(self, video: np.ndarray, first: int, target: np.ndarray) -> None:
        """Copy the window beginning at frame `first` of `video` [1, T, ...] to `target` [1, ...]."""
        if self.window is not None:
            video = video[:, first : first + (self.window - 1) * self.stride + 1 : self.stride]
        video = video.transpose(0, *(1 + axis for axis in self.order))
        if self.to_float:
            np.divide(video, np.float32(255), out=target)
        else:
            target[...] = video
