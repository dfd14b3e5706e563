"""Videos of a dataset drawn again, at any size and in any look, and simulated again from their stored scenes.

A dataset holds all that a frame depends on: what was drawn at random comes back from its key, the rest from its fields.
So a dataset of states alone (`storage: {frames: none}`) is drawn inside the training loop, on its device.
"""

import contextlib
import dataclasses
import functools
import zlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

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
from gen2d.programs.rollout import Rollout, save_at
from gen2d.records import axes
from gen2d.records import keys as keys_module
from gen2d.records.axes import Array
from gen2d.records.layout import Layout
from gen2d.records.scene import Joints, Objects, Scene, State
from gen2d.renderers.camera import CameraView
from gen2d.renderers.plan import FramePlan, RenderScene
from gen2d.sampling.matched import sets as sets_module
from gen2d.xla import on_cpu

FieldColumns = Mapping[str, Any]


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
) -> Any:
    """The frames [n, T, H, W, 3] uint8 of these videos, a jax array on jax's default device.

    Drawn from what is stored; at the stored settings and fingerprint, the stored frames. `height`, `width` (px), `look`
    (a name, or a mapping with a name and options) and `overrides` ('annotations.masks=true', 'image.noise=4') draw them
    otherwise. `states` are those of `simulate_again` instead of the stored ones. With `fields` ("frames",
    "masks/instance") a dictionary of these, the annotations that they belong to switched on.
    A family or look that came with the dataset runs only if it is trusted: this user has generated with it, or `trust`
    holds its sha256.
    Raises ConfigError and UntrustedError (UserErrors), DamagedError, and IndexError where there is no such video.
    """
    base, numbers = config_of(ds, (), trust), ds.numbers(np.atleast_1d(indices))
    config = load_config(base, [*overrides, *_changed(height, width), "storage.frames=video"])
    changed: dict[str, Any] = {} if look is None else {"look": named(look)}
    if asked := _asked(fields, config.annotations):
        changed["annotations"] = config.annotations.plain() | asked
    if changed:
        config = load_config(config.plain() | changed, copies=config.copies)
    if config.image.exposure and states is not None:
        raise ConfigError("states have no motion between frames: image.exposure must be 0 where they are given")
    if config.image.exposure:
        found = _again(ds, config, numbers)
    else:
        columns = dict(_stored(ds, numbers)) | dict(states or {})
        _check_frames(columns, states)
        settings = _Settings(base, config)
        stages = _compiled(_staged, settings)(columns, _key_words(ds), jnp.asarray(numbers, jnp.uint32))
        found = _compiled(_pictures, settings)(stages)
    if fields is None:
        return found["frames"]
    missing = [name for name in fields if name not in found]
    if missing:
        raise ConfigError(f"fields holds {missing[0]!r}, but must be of {', '.join(sorted(found))}")
    return {name: found[name] for name in fields}


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


# ---- What is asked, checked


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
def _compiled(program: Callable, settings: _Settings) -> Callable:
    """One of the programs above for these settings."""
    return jax.jit(functools.partial(program, settings=settings))


def _again(ds: Dataset, config: Config, numbers: np.ndarray) -> dict[str, Array]:
    """Videos made from their keys again, as they were made: what blurs them is not stored."""
    batch_size = ds.manifest.fingerprint["batch_size"]
    found: dict[str, list[Array]] = {}
    order = np.argsort(numbers, kind="stable")
    own_lanes, pictures = (
        load_config(config, [f"storage.batch_size={batch_size}"]),
        _compiled(_pictures, _Settings(config, config)),
    )
    with contextlib.closing(Rollout(own_lanes, jax.devices()[:1])) as rollout:
        for first in sorted({int(number) // batch_size * batch_size for number in numbers}):
            batch = rollout.begin(ds.options.split, [first])
            own = numbers[order][(numbers[order] >= first) & (numbers[order] < first + batch_size)] - first
            stages = jax.tree.map(lambda a, own=own: a[own], batch.stages)
            for name, array in pictures(stages).items():
                found.setdefault(name, []).append(array)
    return {name: jnp.concatenate(parts)[np.argsort(order)] for name, parts in found.items()}
