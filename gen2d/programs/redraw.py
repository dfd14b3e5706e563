"""Videos of a dataset drawn again, at any size and in any look, and simulated again from their stored scenes.

A dataset holds all that a frame depends on: what was drawn at random comes back from its key, the rest from its fields.
So a dataset of states alone (`storage: {frames: none}`) is drawn inside the training loop, on its device.
"""

import contextlib
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
from gen2d.core.errors import ConfigError
from gen2d.loading.dataset import Dataset
from gen2d.loading.protocols import Numbers
from gen2d.physics.params import solver_params
from gen2d.physics.simulate import simulate, substeps
from gen2d.programs import render as render_module
from gen2d.programs.recipe import Trust, config_of
from gen2d.programs.rollout import save_at
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

FieldColumns = Mapping[str, Any]


@overload
def render(
    ds: Dataset,
    indices: Numbers,
    *,
    height: int | None = None,
    width: int | None = None,
    look: str | Mapping[str, Any] | None = None,
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
    look: str | Mapping[str, Any] | None = None,
    overrides: Sequence[str] = (),
    states: FieldColumns | None = None,
    fields: Sequence[str],
    trust: Trust = (),
) -> dict[str, Array]: ...


def render(
    ds: Dataset,
    indices: Numbers,
    *,
    height: int | None = None,
    width: int | None = None,
    look: str | Mapping[str, Any] | None = None,
    overrides: Sequence[str] = (),
    states: FieldColumns | None = None,
    fields: Sequence[str] | None = None,
    trust: Trust = (),
) -> Array | dict[str, Array]:
    """Frames [n, T, H, W, 3] uint8 of the videos with these numbers, as a jax array on jax's default device.

    They are rendered from the stored scenes and states: at the stored settings and fingerprint they equal the stored
    frames.

        frames = gen2d.render(ds, [0, 1], height=256, width=256, look="shaded")
        masks = gen2d.render(ds, range(8), fields=["masks/instance"])["masks/instance"]

    Parameters
    ----------
    ds : an opened dataset; with or without stored frames.
    indices : numbers of videos [n], or one; negative ones count from the end.
    height, width : size of the frames, px; those of the dataset unless given.
    look : a look's name, or a mapping with its name and options.
    overrides : other options of the config ('annotations.masks=true', 'image.noise=4').
    states : fields as `simulate_again` returns them, in place of the stored ones.
    fields : "frames" and names of annotations, which are switched on: the result is then a dictionary of these.
    trust : sha256 of code that came with the dataset and may run. Without it a family or look from a file of the
        dataset runs only if this user has generated with it.

    Raises
    ------
    ConfigError, UntrustedError : where an option cannot be, or code is not trusted; both are UserErrors.
    DamagedError : where a stored field cannot be read.
    IndexError : where there is no such video.
    """
    base, config, numbers = _recipes(ds, indices, height, width, look, overrides, fields, trust)
    if config.image.exposure and states is not None:
        raise ConfigError("states have no motion between frames: image.exposure must be 0 where they are given")
    if config.image.exposure:
        rendered = _again(ds, config, numbers)
    else:
        settings = _Settings(base, config)
        rendered = _compiled(_pictures, settings)(_stages(ds, settings, numbers, states))
    if fields is None:
        return rendered["frames"]
    missing = [name for name in fields if name not in rendered]
    if missing:
        raise ConfigError(f"fields holds {missing[0]!r}, but must be of {', '.join(sorted(rendered))}")
    return {name: rendered[name] for name in fields}


def render_soft(
    ds: Dataset,
    indices: Numbers,
    *,
    states: FieldColumns | None = None,
    sigma: float = 0.0,
    height: int | None = None,
    width: int | None = None,
    look: str | Mapping[str, Any] | None = None,
    overrides: Sequence[str] = (),
    trust: Trust = (),
) -> Array:
    """Frames [n, T, H, W, 3] float32 from 0 to 255 that are differentiable in `states`, without noise or motion blur.

        def loss(position):
            return ((gen2d.render_soft(ds, [0], states={"states/position": position}, sigma=2.0) - target) ** 2).mean()

        slope = jax.grad(loss)(position)

    `sigma`, px, is the standard deviation of a Gaussian that blurs the coverage of each object: with 0 the frames are
    those of `render` but for rounding, and an edge has a slope only in the pixels that it crosses; a larger one gives
    slopes from as far as 4 sigma. `states` are fields by their stored names, [n, T, ...] each, in place of the stored
    ones. The other parameters and errors are those of `render`.
    """
    if not 0 <= sigma <= 1000:
        raise ConfigError(f"sigma is {sigma!r}, but must be a number of pixels from 0 to 1000")
    plain = [*overrides, "image.exposure=0", "image.noise=0"]
    base, config, numbers = _recipes(ds, indices, height, width, look, plain, None, trust)
    settings = _Settings(base, config)
    return _compiled(_soft, settings, float(sigma))(_stages(ds, settings, numbers, states))


def simulate_again(
    ds: Dataset,
    indices: Numbers,
    *,
    fps: float | None = None,
    frames: int | None = None,
    overrides: Sequence[str] = (),
    trust: Trust = (),
) -> dict[str, Array]:
    """The states of these videos at another frame rate or for another number of frames, from their stored scenes.

    Jax arrays by their stored names: "states/position" [n, T, K, 2] in m and so on, "time" [T] in s, and the camera's
    fields; with contacts or energy if the config asks for them. `overrides` may change the physics
    ('physics.damping=0.1').
    At the stored settings the states agree with the stored ones to rounding. `trust` is that of `render`.
    """
    changes = [
        *overrides,
        *([] if fps is None else [f"video.fps={fps}"]),
        *([] if frames is None else [f"video.frames={frames}"]),
    ]
    base, numbers = config_of(ds, (), trust), ds.numbers(np.atleast_1d(indices))
    config = load_config(base, changes)
    if not set(matched.VIOLATIONS).isdisjoint(config.matched.change or ()):
        raise ConfigError(f"{ds.root}: matched.change has violations, which cannot be simulated again from a scene")
    simulated = _compiled(_simulated, _Settings(base, config))
    made = simulated(_stored(ds, numbers), _key_words(ds), jnp.asarray(numbers, jnp.uint32))
    return made | {"time": jnp.arange(config.video.frames) / config.video.fps}


# ---- The recipe, with what is asked for


def _recipes(
    ds: Dataset,
    indices: Numbers,
    height: int | None,
    width: int | None,
    look: str | Mapping[str, Any] | None,
    overrides: Sequence[str],
    fields: Sequence[str] | None,
    trust: Trust,
) -> tuple[Config, Config, np.ndarray]:
    """The dataset's config, that of the frames that are asked for, and the numbers of their videos."""
    base, numbers = config_of(ds, (), trust), ds.numbers(np.atleast_1d(indices))
    config = load_config(base, [*overrides, *_changed(height, width), "storage.frames=video"])
    changed: dict[str, Any] = {} if look is None else {"look": named(look)}
    if asked := _asked(fields, config.annotations):
        changed["annotations"] = config.annotations.plain() | asked
    if changed:
        config = load_config(config.plain() | changed, copies=config.copies)
    return base, config, numbers


def _changed(height: int | None, width: int | None) -> list[str]:
    return [f"video.{name}={value}" for name, value in (("height", height), ("width", width)) if value is not None]


def _asked(fields: Sequence[str] | None, section: Annotations) -> dict[str, Any]:
    """The options that switch on those annotations that these fields belong to."""
    wanted = set(fields or ())
    off = [plugin for plugin in section.pixels if not plugin.options and wanted & plugin.contract.fields.keys()]
    return {plugin.name: plugin.contract.usual for plugin in off}


def _check_frames(columns: FieldColumns, states: FieldColumns | None) -> None:
    frames = {
        len(np.shape(columns[name])) and np.shape(columns[name])[1] for name in ("states/position", "camera/scale")
    }
    if len(frames) > 1:
        raise ConfigError("states and camera have other numbers of frames: give all that simulate_again returned")


# ---- From fields to records


@functools.lru_cache(maxsize=16)
def _whole(ds: Dataset) -> Dataset:
    """The same dataset with every field but images and text."""
    fields = ds.manifest.fields
    names = tuple(name for name, f in fields.items() if f.per_video and not f.is_image and not f.is_text)
    whole = dataclasses.replace(ds.options, fields=names, window=None, stride=1, start="first", layout="THWC")
    frames = ds.manifest.frames[ds.options.split]
    return Dataset(ds.root, ds.manifest, whole.within(frames, ds.manifest.sizes["T"]))


def _stored(ds: Dataset, numbers: np.ndarray) -> dict[str, np.ndarray]:
    return _whole(ds).batch(numbers)


def from_columns(cls: type, columns: FieldColumns) -> Any:
    """The record that holds these fields, arrays by stored name."""
    known = axes.described(cls).items()
    return cls(**{attribute: jnp.asarray(columns[name]) for name, (attribute, _) in known if name in columns})


def scene_of(columns: FieldColumns) -> Scene:
    """The scenes that these fields are of."""
    joints = from_columns(Joints, columns) if "joints/rest" in columns else None
    return Scene(from_columns(Objects, columns), jnp.asarray(columns["world/gravity"]), joints)


def _key_words(ds: Dataset) -> np.ndarray:
    return keys_module.seed_words(ds.manifest.seed, zlib.crc32(ds.options.split.encode()))


@dataclasses.dataclass(frozen=True)
class _Settings:
    """What decides a compiled program: a dataset's config, and that of what is made again."""

    base: Config
    config: Config

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Settings) and self._key == other._key

    @property
    def _key(self) -> tuple[str, str]:
        return self.base.text(), self.config.text()

    @property
    def layout(self) -> Layout:
        return self.config.scene.contract.layout(self.config.scene.options)

    @property
    def plan(self) -> FramePlan:
        return render_module.plan_of(self.config, self.layout)

    def resized(self, view: CameraView) -> CameraView:
        """A stored view for frames of another size: all that was seen is."""
        old, new = self.base.video, self.config.video
        return view._replace(scale=view.scale * min(new.height / old.height, new.width / old.width))


def _stages(ds: Dataset, settings: "_Settings", numbers: np.ndarray, states: FieldColumns | None) -> RenderScene:
    """What these videos are rendered from, with these states instead of the stored ones."""
    columns = dict(_stored(ds, numbers)) | dict(states or {})
    _check_frames(columns, states)
    return _compiled(_staged, settings)(columns, _key_words(ds), jnp.asarray(numbers, jnp.uint32))


def _staged(columns: FieldColumns, words: Array, numbers: Array, settings: _Settings) -> RenderScene:
    config, plan = settings.config, settings.plan
    scene, states = scene_of(columns), from_columns(State, columns)
    view = settings.resized(CameraView(*(jnp.asarray(columns[f"camera/{name}"]) for name in CameraView._fields)))

    def staged(key: Array, scene: Scene, states: State, view: CameraView) -> RenderScene:
        return render_module.render_scene(key, config, plan, scene, states, view)

    return jax.vmap(staged)(sets_module.keys_of(words, numbers, settings.base.matched), scene, states, view)


def _pictures(stages: RenderScene, settings: _Settings) -> dict[str, Array]:
    """What a run draws, in a program of its own, as there: so that its rounding is the same."""
    return render_module.render_frames(stages, settings.plan, settings.config.annotations)


def _soft(stages: RenderScene, settings: _Settings, sigma: float) -> Array:
    return jax.vmap(lambda stage: draw_soft(stage, settings.plan, sigma))(stages)


def _simulated(columns: FieldColumns, words: Array, numbers: Array, settings: _Settings) -> dict[str, Array]:
    config, layout = settings.config, settings.layout
    scene = scene_of(columns)
    first = jax.tree.map(lambda a: a[:, 0], from_columns(State, columns))
    steps = substeps(config.video.fps, config.physics.substeps, config.physics.max_step)
    rules = solver_params(config.physics, config.video.fps, steps)
    keep = dataclasses.replace(save_at(config, layout), between=False)
    device = axes.to_device(scene), axes.to_device(first)
    made = axes.to_stored(simulate(*device, layout, rules, config.video.frames, steps, keep, sparse=on_cpu()))
    keys = sets_module.keys_of(words, numbers, settings.base.matched)
    view = jax.vmap(lambda key, states: render_module.view_of(key, config, layout, states))(keys, made.states)
    return axes.columns(made) | render_module.camera_columns(view)


@functools.lru_cache(maxsize=16)  # a program takes up to thousands of memory maps, of which a process has some 60,000
def _compiled(program: Callable, settings: _Settings, *more: float) -> Callable:
    """One of the programs above for these settings."""
    return jax.jit(lambda *arrays: program(*arrays, settings, *more))


def _again(ds: Dataset, config: Config, numbers: np.ndarray) -> dict[str, Array]:
    """Videos simulated from their keys again, as they were: what blurs them is not stored."""
    config = load_config(config, [f"storage.batch_size={ds.manifest.fingerprint['batch_size']}"])
    with contextlib.closing(VideoSource(config, jax.devices()[:1])) as source:
        names = ["frames", *annotations.fields(config.annotations, {})]
        return {name: jnp.asarray(values) for name, values in source.videos(ds.options.split, numbers, names).items()}
