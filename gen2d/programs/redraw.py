"""Stored videos rendered again, at any size and in any look, or simulated again from their stored scenes.

A dataset determines its frames completely: sampled values are recomputed from each video's key, everything else is
stored. A dataset of states alone (`storage: {frames: none}`) can therefore be rendered inside the training loop, on its
device.
"""

import dataclasses
import functools
import zlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, overload

import jax
import jax.numpy as jnp
import numpy as np

from gen2d import annotations
from gen2d.config import matched
from gen2d.config.annotations import Annotations
from gen2d.config.config import Config, load_config
from gen2d.config.plugin_options import named
from gen2d.config.sections import SENSOR
from gen2d.core.errors import ConfigError
from gen2d.core.progress import waiting
from gen2d.loading.dataset import Dataset
from gen2d.loading.protocols import Numbers
from gen2d.physics.params import solver_params
from gen2d.physics.simulate import simulate
from gen2d.programs import render as render_module
from gen2d.programs.recipe import Trust, config_of
from gen2d.programs.shared import cached_jit
from gen2d.programs.simulation import save_at, steps_of
from gen2d.programs.source import VideoSource
from gen2d.records import axes
from gen2d.records import keys as keys_module
from gen2d.records.axes import Array
from gen2d.records.layout import Layout
from gen2d.records.scene import Joints, Objects, Scene, State
from gen2d.renderers.camera import CameraView
from gen2d.renderers.plan import FramePlan, RenderScene
from gen2d.renderers.rasterizer import draw_soft
from gen2d.sampling.matched import sets as sets_module
from gen2d.xla import on_cpu

FieldColumns = Mapping[str, Array | np.ndarray]


@overload
def render(
    ds: Dataset,
    indices: Numbers,
    *,
    height: int | None = None,
    width: int | None = None,
    look: str | Mapping[str, object] | None = None,
    overrides: Sequence[str] = (),
    states: FieldColumns | None = None,
    fields: None = None,
    trust: Trust = (),
) -> Array: ...


@overload
def render(
    ds: Dataset,
    indices: Numbers,
    *,
    height: int | None = None,
    width: int | None = None,
    look: str | Mapping[str, object] | None = None,
    overrides: Sequence[str] = (),
    states: FieldColumns | None = None,
    fields: Sequence[str],
    trust: Trust = (),
) -> dict[str, Array]: ...


@waiting("Compiling, and rendering videos")
def render(
    ds: Dataset,
    indices: Numbers,
    *,
    height: int | None = None,
    width: int | None = None,
    look: str | Mapping[str, object] | None = None,
    overrides: Sequence[str] = (),
    states: FieldColumns | None = None,
    fields: Sequence[str] | None = None,
    trust: Trust = (),
) -> Array | dict[str, Array]:
    """Frames of stored videos, rendered from their stored scenes and states.

    With the stored settings and fingerprint, the frames equal the stored ones.

    Parameters
    ----------
    ds : Dataset
        An open dataset, with or without stored frames.
    indices : int or sequence of int, [n]
        Numbers of the videos; negative ones count from the end.
    height, width : int, optional
        Size of the frames in px; by default that of the dataset.
    look : str or mapping, optional
        Name of a look, or a mapping of its name and options.
    overrides : sequence of str
        Other options of the config, such as 'annotations.masks=true' or 'image.noise=4'.
    states : mapping, optional
        Fields by stored name [n, T, ...], as `simulate_again` returns them; they replace the stored ones.
    fields : sequence of str, optional
        "frames" and names of annotations, which are switched on.
    trust : str or sequence of str
        sha256 of code in the dataset that may run. Otherwise, a family or look from a file of the dataset runs only if
        this user has generated with it.

    Returns
    -------
    jax.Array, uint8 [n, T, H, W, 3]
        The frames, on jax's default device; with `fields`, a dictionary of the named arrays instead.

    Raises
    ------
    ConfigError
        If an option is invalid or there is no such field.
    UntrustedError
        If the dataset needs code that is not trusted.
    DamagedError
        If a stored field cannot be read.
    UnreachableError
        If a server does not answer.
    IndexError
        If there is no such video.

    Examples
    --------
    >>> frames = gen2d.render(ds, [0, 1], height=256, width=256, look="shaded")
    >>> masks = gen2d.render(ds, range(8), fields=["masks/instance"])["masks/instance"]
    """
    base, config = configs_of(ds, height, width, look, overrides, fields, trust)
    numbers = ds._numbers(np.atleast_1d(indices))
    if config.image.exposure and states is not None:
        raise ConfigError("states have no motion between frames: image.exposure must be 0 where they are given")
    if config.image.exposure:
        rendered = regenerate(ds, config, numbers)
    else:
        settings = RenderSettings(base, config)
        rendered = _compile(render_frames, settings)(_render_scenes(ds, settings, numbers, states))
    if fields is None:
        return rendered["frames"]
    missing = [name for name in fields if name not in rendered]
    if missing:
        raise ConfigError(f"fields holds {missing[0]!r}, but must be of {', '.join(sorted(rendered))}")
    return {name: rendered[name] for name in fields}


@waiting("Compiling, and rendering videos")
def render_soft(
    ds: Dataset,
    indices: Numbers,
    *,
    states: FieldColumns | None = None,
    sigma: float = 0.0,
    height: int | None = None,
    width: int | None = None,
    look: str | Mapping[str, object] | None = None,
    overrides: Sequence[str] = (),
    trust: Trust = (),
) -> Array:
    """Frames that are differentiable in `states`, without motion blur, lens and sensor.

    Parameters
    ----------
    ds : Dataset
        An open dataset, with or without stored frames.
    indices : int or sequence of int, [n]
        Numbers of the videos; negative ones count from the end.
    states : mapping, optional
        Fields by stored name [n, T, ...]; they replace the stored ones.
    sigma : float
        Standard deviation, in px, of a Gaussian that blurs the coverage of each object, from 0 to 1000. With 0, the
        frames are those of `render` before rounding, and only pixels that an edge crosses have a gradient. A larger
        value extends the gradient to pixels up to 4 sigma away.
    height, width, look, overrides, trust
        As in `render`.

    Returns
    -------
    jax.Array, float32 [n, T, H, W, 3]
        The frames, from 0 to 255.

    Raises
    ------
    ConfigError
        If sigma is out of range; otherwise as `render`.

    Examples
    --------
    >>> def loss(position):
    ...     frames = gen2d.render_soft(ds, [0], states={"states/position": position}, sigma=2.0)
    ...     return ((frames - target) ** 2).mean()
    >>> gradient = jax.grad(loss)(position)
    """
    if not 0 <= sigma <= 1000:
        raise ConfigError(f"sigma is {sigma!r}, but must be a number of pixels from 0 to 1000")
    off = ["image.jpeg_quality=null", *(f"image.{name}=0" for name in SENSOR if name != "jpeg_quality")]
    plain = [*overrides, "image.exposure=0", *off]
    base, config = configs_of(ds, height, width, look, plain, None, trust)
    numbers, settings = ds._numbers(np.atleast_1d(indices)), RenderSettings(base, config)
    return _compile(_render_soft_frames, settings, float(sigma))(_render_scenes(ds, settings, numbers, states))


@waiting("Compiling, and simulating videos")
def simulate_again(
    ds: Dataset,
    indices: Numbers,
    *,
    fps: float | None = None,
    frames: int | None = None,
    overrides: Sequence[str] = (),
    trust: Trust = (),
) -> dict[str, Array]:
    """States of stored videos, simulated again from their first frames.

    With the stored settings, the states agree with the stored ones up to rounding.

    Parameters
    ----------
    ds : Dataset
        An open dataset.
    indices : int or sequence of int, [n]
        Numbers of the videos; negative ones count from the end.
    fps : float, optional
        Frame rate in frames/s; by default that of the dataset.
    frames : int, optional
        Number of frames T; by default that of the dataset.
    overrides : sequence of str
        Other options of the config, such as 'physics.damping=0.1'.
    trust : str or sequence of str
        As in `render`.

    Returns
    -------
    dict of jax.Array
        Fields by stored name: "states/position" [n, T, K, 2] in m and the other states, "time" [T] in s, and the
        camera's fields; contacts and energy if the config enables them. With physics.precision=float64, what is
        simulated is float64.

    Raises
    ------
    ConfigError
        If an option is invalid, or the dataset has matched sets with violations.
    UntrustedError
        If the dataset needs code that is not trusted.
    DamagedError
        If a stored field cannot be read.
    IndexError
        If there is no such video.

    Examples
    --------
    >>> states = gen2d.simulate_again(ds, [0, 1], fps=120, overrides=["physics.damping=0.1"])
    >>> frames = gen2d.render(ds, [0, 1], states=states)
    """
    changes = [
        *overrides,
        *([] if fps is None else [f"video.fps={fps}"]),
        *([] if frames is None else [f"video.frames={frames}"]),
    ]
    base, numbers = config_of(ds, (), trust), ds._numbers(np.atleast_1d(indices))
    config = load_config(base, changes)
    if not set(matched.VIOLATIONS).isdisjoint(config.matched.change or ()):
        raise ConfigError(f"{ds.root}: matched.change has violations, which cannot be simulated again from a scene")
    simulated = _compile(_simulate_columns, RenderSettings(base, config), x64=config.physics.x64)
    columns = simulated(_with_all_fields(ds).batch(numbers), seed_words_of(ds), jnp.asarray(numbers, jnp.uint32))
    with jax.enable_x64(config.physics.x64):
        return columns | {"time": jnp.arange(config.video.frames) / config.video.fps}


# ---- Configs


def configs_of(
    ds: Dataset,
    height: int | None = None,
    width: int | None = None,
    look: str | Mapping[str, object] | None = None,
    overrides: Sequence[str] = (),
    fields: Sequence[str] | None = None,
    trust: Trust = (),
) -> tuple[Config, Config]:
    """The dataset's config, and the config of the requested frames. Parameters and errors are those of `render`."""
    base = config_of(ds, (), trust)
    size = [f"video.{name}={value}" for name, value in (("height", height), ("width", width)) if value is not None]
    config = load_config(_without_unneeded(base, fields), [*overrides, *size, "storage.frames=video"])
    changes: dict[str, Any] = {} if look is None else {"look": named(look)}
    if annotation_changes := _annotation_changes(fields, config.annotations):
        changes["annotations"] = config.annotations.plain() | annotation_changes
    if changes:
        config = load_config(config.plain() | changes, copies=config.copies)
    return base, config


def _without_unneeded(config: Config, fields: Sequence[str] | None) -> Config:
    """The config without those annotations that not every look can have and that none of these fields is of."""
    requested, pixels = set(fields or ()), []
    for plugin in config.annotations.pixels:
        kept = not plugin.contract.needs or requested & plugin.contract.fields.keys()
        pixels.append(plugin if kept else dataclasses.replace(plugin, options=plugin.contract.off))
    return dataclasses.replace(config, annotations=dataclasses.replace(config.annotations, pixels=tuple(pixels)))


def _annotation_changes(fields: Sequence[str] | None, section: Annotations) -> dict[str, Any]:
    """Options that switch on the annotations of these fields."""
    requested = set(fields or ())
    off = [plugin for plugin in section.pixels if not plugin.options and requested & plugin.contract.fields.keys()]
    return {plugin.name: plugin.contract.usual for plugin in off}


# ---- From fields to records


@functools.lru_cache(maxsize=16)
def _with_all_fields(ds: Dataset) -> Dataset:
    """The same dataset with every field but images and text."""
    fields = ds.manifest.fields
    names = tuple(name for name, f in fields.items() if f.per_video and not f.is_image and not f.is_text)
    options = dataclasses.replace(ds.options, fields=names, window=None, stride=1, start="first", layout="THWC")
    frames = ds.manifest.frames[ds.options.split]
    return Dataset(ds.root, ds.manifest, options.within(frames, ds.manifest.sizes["T"]))


def from_columns(cls: type, columns: FieldColumns) -> Any:
    """A record of class `cls` from arrays by stored name."""
    fields = axes.stored_fields(cls).items()
    return cls(**{attribute: jnp.asarray(columns[name]) for name, (attribute, _) in fields if name in columns})


def scene_of(columns: FieldColumns) -> Scene:
    """The scenes that these fields describe."""
    joints = from_columns(Joints, columns) if "joints/rest" in columns else None
    return Scene(from_columns(Objects, columns), jnp.asarray(columns["world/gravity"]), joints)


def seed_words_of(ds: Dataset) -> np.ndarray:
    """Words of the keys of a split's videos, uint32 [3]."""
    return keys_module.seed_words(ds.manifest.seed, zlib.crc32(ds.options.split.encode()))


@dataclasses.dataclass(frozen=True)
class RenderSettings:
    """Key of a compiled program: the config of the dataset and that of the requested videos."""

    base: Config
    config: Config

    @property
    def layout(self) -> Layout:
        return self.config.scene.contract.layout(self.config.scene.options)

    @property
    def plan(self) -> FramePlan:
        return render_module.plan_of(self.config, self.layout)

    @property
    def texts(self) -> tuple[str, ...]:
        """Everything that the settings hold, as text."""
        copies = {**self.base.copies, **self.config.copies}
        return self.base.recipe_text(), self.config.recipe_text(), repr(sorted(copies.items()))

    @property
    def zoom(self) -> float:
        """Scale of the requested frames, relative to those of the dataset: everything stays in view."""
        old, new = self.base.video, self.config.video
        return min(new.height / old.height, new.width / old.width)


def _render_scenes(
    ds: Dataset, settings: RenderSettings, numbers: np.ndarray, states: FieldColumns | None
) -> RenderScene:
    """Render scenes of these videos; `states` replace the stored ones."""
    columns: FieldColumns = {**_with_all_fields(ds).batch(numbers), **(states or {})}
    shapes = [np.shape(columns[name]) for name in ("states/position", "camera/scale")]
    if len({len(shape) and shape[1] for shape in shapes}) > 1:
        raise ConfigError("states and camera have other numbers of frames: give all that simulate_again returned")
    scenes = _compile(build_render_scenes, settings)(columns, seed_words_of(ds), jnp.asarray(numbers, jnp.uint32))
    return render_module.with_pictures(scenes, settings.config)


def build_render_scenes(columns: FieldColumns, words: Array, numbers: Array, settings: RenderSettings) -> RenderScene:
    """Render scenes of the videos with these numbers [n], from their stored fields [n, ...]."""
    config, plan = settings.config, settings.plan
    scene, states = scene_of(columns), from_columns(State, columns)
    view = CameraView(*(jnp.asarray(columns[f"camera/{name}"]) for name in CameraView._fields))
    view = view._replace(scale=view.scale * settings.zoom)

    def build(key: Array, scene: Scene, states: State, view: CameraView) -> RenderScene:
        return render_module.render_scene(key, config, plan, scene, states, view)

    return jax.vmap(build)(sets_module.keys_of(words, numbers, settings.base.matched), scene, states, view)


def render_frames(render_scenes: RenderScene, settings: RenderSettings) -> dict[str, Array]:
    """Frames and annotations, from a separate program as in a run, so that they round alike."""
    return render_module.render_frames(render_scenes, settings.plan, settings.config.annotations)


def _render_soft_frames(render_scenes: RenderScene, settings: RenderSettings, sigma: float) -> Array:
    return jax.vmap(lambda render_scene: draw_soft(render_scene, settings.plan, sigma))(render_scenes)


def _simulate_columns(
    columns: FieldColumns, words: Array, numbers: Array, settings: RenderSettings
) -> dict[str, Array]:
    config, layout = settings.config, settings.layout
    first = jax.tree.map(lambda a: a[:, 0], from_columns(State, columns))
    scene, first = axes.to_precision((scene_of(columns), first), config.physics.precision)
    steps = steps_of(config)
    rules = solver_params(config.physics, config.video.fps, steps)
    saved = dataclasses.replace(save_at(config, layout), between=False)
    start = axes.to_device(scene), axes.to_device(first)
    trajectory = axes.to_stored(simulate(*start, layout, rules, config.video.frames, steps, saved, sparse=on_cpu()))
    keys = sets_module.keys_of(words, numbers, settings.base.matched)
    states = axes.to_precision(trajectory.states, "float32")
    with jax.enable_x64(False):
        view = jax.vmap(lambda key, states: render_module.view_of(key, config, layout, states))(keys, states)
    return axes.columns(trajectory) | render_module.camera_columns(view)


@functools.lru_cache(maxsize=16)
def _compile(
    program: Callable[..., Any], settings: RenderSettings, *more: float, x64: bool = False
) -> Callable[..., Any]:
    """One of the functions above, compiled for these settings with the options of a run, so that they round alike."""

    def run(*arrays: Any) -> Any:
        return program(*arrays, settings, *more)

    key = program.__name__, *settings.texts, more
    return cached_jit(run, key, bool(settings.config.copies), x64)


def regenerate(ds: Dataset, config: Config, numbers: np.ndarray) -> dict[str, Array]:
    """Frames and annotations of videos that are sampled and simulated again, as motion blur needs unsaved states."""
    config = load_config(config, [f"storage.batch_size={ds.manifest.fingerprint['batch_size']}"])
    source = VideoSource(config, jax.devices()[:1])
    names = ["frames", *annotations.fields(config.annotations, {})]
    return {name: jnp.asarray(values) for name, values in source.videos(ds.options.split, numbers, names).items()}
