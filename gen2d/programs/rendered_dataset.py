"""Datasets whose frames are rendered when they are read, from the stored scenes and states.

Frames are rendered in slices of a fixed number of videos, by programs that are compiled once. Neither the batch nor the
number of threads affects their bits.
"""

import dataclasses
import functools
import logging
import os
import sys
import threading
from collections.abc import Collection, Mapping
from typing import Any

import jax
import numpy as np

from gen2d import annotations
from gen2d.config.config import Config
from gen2d.core.errors import ConfigError, UserError
from gen2d.core.sizes import power_of_two
from gen2d.dataset.folder import describe_differences
from gen2d.dataset.manifest import Manifest
from gen2d.loading.column import Column
from gen2d.loading.dataset import Dataset, RenderOptions, ViewOptions, select_fields
from gen2d.loading.protocols import Batch, Numbers
from gen2d.programs import devices
from gen2d.programs.environment import sources
from gen2d.programs.fingerprint import fingerprint, machine
from gen2d.programs.recipe import Trust, config_from
from gen2d.programs.redraw import (
    RenderSettings,
    build_render_scenes,
    configs_of,
    regenerate,
    render_frames,
    seed_words_of,
)
from gen2d.programs.render import with_pictures
from gen2d.programs.rollout import Rollout
from gen2d.programs.schema import FRAMES
from gen2d.programs.shared import cached_jit
from gen2d.records import axes
from gen2d.records.axes import Array
from gen2d.records.scene import Joints, Objects, Scene, State
from gen2d.renderers.plan import RenderScene
from gen2d.storage.paths import Place

SLICE_BYTES = 2**22  # of frames rendered at once; a slice that is not full costs as much as a full one
# Fields of a scene and its states, without the camera's.
RECORDS = {name for record in (Scene, Objects, Joints, State) for name in axes.stored_fields(record)}

_PID = os.getpid()  # of the process that imported jax
_LOCK = threading.Lock()  # programs are traced and compiled by one thread at a time
_log = logging.getLogger(__name__)


class RenderedDataset(Dataset):
    """A Dataset whose frames and pixel annotations are rendered on jax's default device, as `gen2d.open` returns it.

    All other fields are read; `camera/scale` is that of the rendered frames. A window's frames are rendered alone,
    unless there is sensor noise or annotations are rendered, too. With motion blur, whole batches are simulated again,
    which is slow.

    Parameters
    ----------
    root : Place
        Folder of the dataset.
    manifest : Manifest
        Contents of its manifest.json.
    options : ViewOptions
        Split, fields (names or patterns), window, layout and so on.
    render : RenderOptions, optional
        Options of the frames. If none but `trust` is given, only fields that are not stored are rendered.

    Raises
    ------
    ConfigError
        If an option is invalid, or if there is no such field.
    UntrustedError
        If the dataset needs code that is not trusted.
    """

    def __init__(
        self, root: Place, manifest: Manifest, options: ViewOptions, render: RenderOptions | None = None
    ) -> None:
        self.render = render
        changes = {name for name in render or {} if name != "trust"}
        without_fields = Dataset(root, manifest, dataclasses.replace(options, fields=()))
        base, config = _configs(without_fields, options.fields, render)
        renderable = {"frames": FRAMES}
        for plugin in config.annotations.pixels:
            renderable |= plugin.contract.fields
        names = select_fields(f"{root}", manifest.fields, options.fields, renderable)
        rendered = {n: renderable[n] for n in names if n in renderable and (changes or n not in manifest.fields)}
        stored = tuple(name for name in names if name not in rendered)
        super().__init__(root, manifest, dataclasses.replace(options, fields=stored))
        self.options = dataclasses.replace(options, fields=names)
        self._settings = settings = RenderSettings(base, _with_annotations(config, rendered))

        video, image = config.video, config.image
        # Noise depends on the number of the frame, motion blur and some annotations on neighbouring frames.
        noisy = not {"noise", "shot_noise"}.isdisjoint(image.sensor)
        whole = rendered.keys() != {"frames"} or image.exposure > 0 or noisy
        every_frame = {"window": None, "stride": 1, "start": "first"} if whole else {}
        self._inputs, self._whole = dataclasses.replace(options, fields=(), window_fields=False, **every_frame), whole
        self._started: _Renderer | None = None

        sizes = {name: self.sizes[name] for name in "TK"} | {"H": video.height, "W": video.width}
        self.sizes |= annotations.sizes(settings.config.annotations, settings.plan, sizes)
        frames = sizes["T"] if whole or options.window is None else options.window
        shown = dataclasses.replace(manifest, fields={**manifest.fields, **rendered}, sizes=self.sizes | {"T": frames})
        window = options.window if whole else None
        columns = {n: Column(n, shown, options.layout, window, options.stride, options.dtype) for n in rendered}
        self._rendered_columns = list(columns.values())
        columns |= {column.name: column for column in self._stored_columns}
        self._columns = [columns[name] for name in names]
        self.fields = {name: columns[name].field for name in names}
        video_bytes = sum(column.size for column in self._rendered_columns)
        self._slice_size = power_of_two(SLICE_BYTES // video_bytes) if rendered else 1

    def __reduce__(self) -> tuple[Any, ...]:
        return RenderedDataset, (self.root, self.manifest, self.options, self.render)

    def _at(self, manifest: Manifest) -> "RenderedDataset":
        return RenderedDataset(self.root, manifest, self.options, self.render)

    @property
    def exact(self) -> bool:
        """Whether rendered frames equal, to the bit, those that the run of the dataset stored or would have stored."""
        return self._renderer.exact

    @property
    def _renderer(self) -> "_Renderer":
        """Programs that render this dataset, compiled when they are first needed."""
        if os.getpid() != _PID:
            raise UserError(
                f"{self.root}: frames are rendered by jax, which does not work in a forked process: load with "
                "gen2d.DataLoader or num_workers=0, or start the workers with multiprocessing_context='spawn'"
            )
        with _LOCK:
            if self._started is None:
                self._started = _Renderer(self, self._settings, self._inputs, self._slice_size)
            return self._started

    def _fill(self, out: Batch, rows: Numbers, indices: Numbers, starts: Numbers | None = None) -> None:
        """Read and render the videos with these indices into `out`. Parameters and errors are those of `Dataset._fill`.

        Raises UserError in a process that was forked from the one that opened the dataset.
        """
        numbers, targets = self._numbers(indices), np.asarray(rows)
        if self._stored_columns:
            super()._fill(out, rows, numbers, starts)
        else:
            self._fill_window(out, targets, self._begins(numbers, starts))
        if "camera/scale" in self.fields:
            out["camera/scale"][targets] *= np.float32(self._settings.zoom)  # px of these frames
        if not self._rendered_columns:
            return
        renderer, begins = self._renderer, self._begins(numbers, starts)
        inputs = renderer.inputs.batch(numbers, None if self._whole else begins)
        size = max(1, len(numbers)) if self._settings.config.image.exposure else self._slice_size
        for first in range(0, len(numbers), size):
            part = np.arange(first, min(first + size, len(numbers)))
            padded = np.minimum(np.arange(first, first + size), len(numbers) - 1)  # with the last video
            rendered = renderer(numbers[padded], {name: values[padded] for name, values in inputs.items()})
            for column in self._rendered_columns:
                _write(column, np.asarray(rendered[column.name])[: len(part)], begins[part], out, targets[part])


def _write(column: Column, videos: np.ndarray, begins: np.ndarray, out: Batch, rows: np.ndarray) -> None:
    """Copy the windows of rendered videos that begin at these frames to these rows of a batch."""
    target, first = out[column.name], int(rows[0])
    if column.is_direct and (np.diff(rows) == 1).all():
        target[first : first + len(rows)] = videos  # a quarter faster than single videos
        return
    for video, begin, row in zip(videos, begins.tolist(), rows.tolist(), strict=True):
        column.convert(video[None], begin, target[row : row + 1])


class _Renderer:
    """Programs that render slices of `size` videos of a dataset; `inputs` is the dataset of the fields that they read.

    `view` holds the options with which these fields are read.
    """

    def __init__(self, ds: RenderedDataset, settings: RenderSettings, view: ViewOptions, size: int) -> None:
        if "torch" in sys.modules:  # leave it its share of a GPU's memory
            os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
        devices.prepare()
        self._ds, self._config, self._words = ds, settings.config, seed_words_of(ds)
        self.exact = _is_exact(ds, settings)
        fields: tuple[str, ...] = ()
        if not settings.config.image.exposure:
            fields = tuple(name for name in ds.manifest.fields if name in RECORDS or name.startswith("camera/"))
            like = Dataset(ds.root, ds.manifest, dataclasses.replace(view, fields=fields)).empty(size)
            shapes = tuple((name, values.shape, values.dtype.str) for name, values in like.items())
            fields, self._build, self._draw = _compile(settings, shapes)
        self.inputs = Dataset(ds.root, ds.manifest, dataclasses.replace(view, fields=fields))

    def __call__(self, numbers: np.ndarray, columns: Batch) -> Mapping[str, Array]:
        """Rendered fields [n, ...] of videos, from their numbers [n] and their `inputs` [n, ...]."""
        if self._config.image.exposure:
            with _LOCK:
                return regenerate(self._ds, self._config, numbers)
        scenes = self._build(columns, self._words, numbers.astype(np.uint32))
        return self._draw(with_pictures(scenes, self._config))


Shapes = tuple[tuple[str, tuple[int, ...], str], ...]  # name, shape and dtype of each field


@functools.lru_cache(maxsize=8)  # splits, and loaders that are opened again, share programs
def _compile(settings: RenderSettings, shapes: Shapes) -> tuple[tuple[str, ...], Any, Any]:
    """Stored fields that frames depend on, and the programs: from these fields to render scenes, and on to frames."""
    columns = {name: jax.ShapeDtypeStruct(shape, dtype) for name, shape, dtype in shapes}
    words, numbers = (jax.ShapeDtypeStruct(shape, np.uint32) for shape in ((3,), shapes[0][1][:1]))
    jaxpr = jax.make_jaxpr(functools.partial(build_render_scenes, settings=settings))(columns, words, numbers).jaxpr
    used = {id(variable) for equation in jaxpr.eqns for variable in equation.invars} | set(map(id, jaxpr.outvars))
    fields = tuple(name for name, variable in zip(sorted(columns), jaxpr.invars, strict=False) if id(variable) in used)
    unused = {name: np.zeros(like.shape, like.dtype) for name, like in columns.items() if name not in fields}

    def build(columns: dict[str, Array], words: Array, numbers: Array) -> RenderScene:
        return build_render_scenes(columns | unused, words, numbers, settings)

    def draw(render_scenes: RenderScene) -> dict[str, Array]:
        return render_frames(render_scenes, settings)

    key, own_code = (*settings.texts, shapes), bool(settings.config.copies)
    return fields, cached_jit(build, key, own_code), cached_jit(draw, key, own_code)


def _configs(ds: Dataset, names: Collection[str], render: RenderOptions | None) -> tuple[Config, Config]:
    """The dataset's config, and the config of the requested frames. Raises ConfigError for an invalid option."""
    options: RenderOptions = {} if render is None else render
    for name in options:
        if name not in RenderOptions.__annotations__:
            raise ConfigError(f"render has {name!r}, but may have {', '.join(RenderOptions.__annotations__)}")
    return configs_of(ds, fields=[*names], **options)


def _with_annotations(config: Config, names: Collection[str]) -> Config:
    """The config with only those pixel annotations that have some of these fields."""
    pixels = []
    for plugin in config.annotations.pixels:
        wanted = plugin.contract.fields.keys() & names
        pixels.append(plugin if wanted else dataclasses.replace(plugin, options=plugin.contract.off))
    return dataclasses.replace(config, annotations=dataclasses.replace(config.annotations, pixels=tuple(pixels)))


def _is_exact(ds: RenderedDataset, settings: RenderSettings) -> bool:
    """Whether these settings, on this machine, give the frames of the dataset to the bit; logs the answer."""
    base, config = settings.base, settings.config
    if dataclasses.replace(config, annotations=base.annotations, storage=base.storage) != base:
        _log.info("%s: frames are rendered with other settings than those of the dataset", ds.root)
        return False
    difference = _fingerprint_difference(ds, (ds.render or {}).get("trust", ()))
    if difference:
        _log.warning(
            "%s: rendered frames may differ by a grey level from those of the dataset: %s", ds.root, difference
        )
    else:
        _log.info("%s: rendered frames are those of the dataset, to the bit", ds.root)
    return not difference


def _fingerprint_difference(ds: Dataset, trust: Trust) -> str:
    """What differs between the fingerprint of the dataset and that of this machine; empty if they are equal."""
    made_by, here = ds.manifest.producer.get("sources") or {}, sources()
    stored = dict(ds.manifest.fingerprint)
    rollout = Rollout(config_from(ds.root, ds.manifest.identity, trust), jax.local_devices()[:1])
    own = machine(rollout)
    if own == {name: value for name, value in stored.items() if name != "programs"}:
        own = fingerprint(rollout)
    else:
        stored.pop("programs", None)  # tracing programs is slow
    difference = describe_differences({"fingerprint": stored}, {"fingerprint": own}, made_by, here)
    if difference or "frames" in ds.manifest.fields:
        return difference
    # The fingerprint of a run without frames does not cover the rasterizer.
    names = (name for name in made_by.keys() | here.keys() if name.startswith("renderers/"))
    edited = sorted(name for name in names if made_by.get(name) != here.get(name))
    return f"{', '.join(edited[:5])} differ" if edited else ""
