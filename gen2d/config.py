"""What a dataset is made from: every option with its unit, default and range, read from YAML and checked once, here.

An error is one sentence with the file, the field, its value and what is allowed.
"""

import dataclasses
import hashlib
import json
import pathlib
import re
from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import Any

import yaml

from gen2d import matched, plugins
from gen2d.codecs import CODECS
from gen2d.errors import ConfigError
from gen2d.factors import Distribution, is_number, parse

MAX_SEED = 2**63 - 1
MAX_SLOTS = 254  # a slot's mask id is one byte, 0 is the background


@dataclasses.dataclass(frozen=True)
class Option:
    """What an option may be. `parts` > 0: a list of so many values. `draw`: a distribution, else a single value; of a
    scene family a factor, `each` names what every one has a draw of its own for."""

    kind: type  # int, float, str or bool
    unit: str
    meaning: str
    low: float | None = None
    high: float | None = None
    above: float | None = None
    choices: tuple[str, ...] = ()
    draw: bool = False
    parts: int = 0
    each: str = ""
    optional: bool = False  # may be null: decided by the program
    several: bool = False  # may be a list of such values

    @property
    def allowed(self) -> str:
        """What the option may be, for a sentence."""
        if self.choices:
            return "one of " + ", ".join(self.choices)
        if self.kind is bool:
            return "true or false"
        noun = {int: "whole number", float: "number", str: "text"}[self.kind]
        ends = [
            f"above {self.above:g}" if self.above is not None else "",
            f"{self.low:g} or more" if self.low is not None else "",
        ]
        ends.append(f"{self.high:g} or less" if self.high is not None else "")
        limits = " and ".join(end for end in ends if end)
        text = f"a {noun}" if not self.parts else f"a list of {self.parts} {noun}s"
        text += f" or a list of {noun}s" if self.several else ""
        return text + (f", {limits}" if limits else "") + (" (or null)" if self.optional else "")


def option(default: Any, kind: type, unit: str, meaning: str, **limits: Any) -> Any:
    """A dataclass field that is an option; a drawn one's default is written as in a config."""
    spec = Option(kind, unit, meaning, **limits)
    if spec.draw and default is not None:
        default = [parse(v, kind is int) for v in default] if spec.parts else parse(default, kind is int)
    if isinstance(default, list):
        default = tuple(default)
    return dataclasses.field(default=default, metadata={"option": spec})


@dataclasses.dataclass(frozen=True)
class VideoOptions:
    """How long, how fast and how large."""

    frames: int = option(64, int, "frames", "in a video, the initial state included", low=1, high=100_000)
    fps: float = option(30.0, float, "1/s", "frames per second of the world's time", above=0, high=100_000)
    height: int = option(64, int, "px", "of a frame", low=4, high=8192)
    width: int = option(64, int, "px", "of a frame", low=4, high=8192)


@dataclasses.dataclass(frozen=True)
class PhysicsOptions:
    """How the world is stepped, and how two materials make one contact."""

    substeps: int | None = option(
        None, int, "steps/frame", "null: as many as max_step asks for", low=1, high=10_000, optional=True
    )
    max_step: float = option(1 / 240, float, "s", "longest step where substeps is null", above=0, high=1)
    mixing: str = option(
        "product", str, "", "of two elasticities or frictions", choices=("product", "mean", "max", "geometric")
    )
    damping: float = option(0.0, float, "1/s", "rate at which velocity and spin die away", low=0, high=1000)
    bounce_threshold: float = option(
        0.01, float, "m/s", "slower impacts do not bounce, nor any that gravity makes in two steps", low=0
    )
    contact_hertz: float = option(
        30.0, float, "Hz", "stiffness of an overlapping contact; at most 1/8 of the step rate", above=0
    )
    contact_damping_ratio: float = option(10.0, float, "1", "of an overlapping contact", above=0)
    push_speed: float = option(3.0, float, "m/s", "an overlap is undone no faster", above=0)


@dataclasses.dataclass(frozen=True)
class CameraOptions:
    """What part of the world a frame shows, and how the camera moves."""

    center: tuple[float, ...] | None = option(
        None, float, "m", "world point in the middle of the frame; null: the scene's", parts=2, optional=True
    )
    scale: float | None = option(
        None, float, "px/m", "pixels per metre; null: all of the scene", above=0, high=1e6, optional=True
    )
    margin: float = option(0.0, float, "m", "shown around the scene where scale is null", low=0)
    angle: Distribution = option(0.0, float, "rad", "of the camera, counter-clockwise", draw=True)
    pan: tuple[Distribution, ...] = option([0, 0], float, "m/s", "speed of the camera", parts=2, draw=True)
    zoom: Distribution = option(0.0, float, "1/s", "rate at which the scale grows", draw=True, low=-100, high=100)
    turn: Distribution = option(0.0, float, "rad/s", "at which the camera turns", draw=True)
    shake: Distribution = option(0.0, float, "m", "of a hand's tremor, rms in each direction", draw=True, low=0)
    shake_hertz: float = option(4.0, float, "Hz", "lowest frequency of the tremor", above=0)
    follow: int | None = option(
        None, int, "slot", "of the object that stays in the middle of the frame; null: none", low=0, optional=True
    )


@dataclasses.dataclass(frozen=True)
class ImageOptions:
    """How an image forms: how colours mix, how long the shutter is open, what stands before it, and how it is read."""

    blending: str = option(
        "srgb", str, "", "of a pixel's colours: as most tools do, or in linear light", choices=("srgb", "linear")
    )
    exposure: float = option(
        0.0,
        float,
        "frames",
        "for which the shutter is open, until the frame's instant; 0: no motion blur",
        low=0,
        high=1,
    )
    exposure_samples: int = option(8, int, "samples", "of an exposure, evenly in time", low=2, high=256)
    noise: Distribution = option(
        0.0, float, "sRGB", "standard deviation of a video's sensor noise", draw=True, low=0, high=255
    )
    occluders: int = option(0, int, "rectangles", "that stand before objects and do not take part", low=0, high=16)
    occluder_width: Distribution = option([0.1, 0.3], float, "1", "of an occluder, over the frame's", draw=True, low=0)
    occluder_height: Distribution = option([0.1, 0.6], float, "1", "of an occluder, over the frame's", draw=True, low=0)
    occluder_front: Distribution = option(
        1.0, float, "1", "share of the objects that an occluder stands before, in their drawing order",
        draw=True, low=0, high=1,
    )  # fmt: skip
    occluder_color: tuple[Distribution, ...] = option(
        [[60, 140]] * 3, int, "sRGB", "of an occluder", parts=3, draw=True, low=0, high=255
    )


@dataclasses.dataclass(frozen=True)
class AnnotationOptions:
    """What is stored beside frames and states."""

    masks: bool = option(False, bool, "", "which object each pixel shows")
    amodal: bool = option(False, bool, "", "where each object is, seen or not, a bit a pixel")
    boxes: bool = option(False, bool, "", "around what is seen of each object, and around all of it")
    visibility: bool = option(False, bool, "", "how many pixels of each object are seen, and which part of it")
    flow: bool = option(False, bool, "", "where each pixel goes to in the next frame, and came from")
    tracks: int = option(0, int, "points", "fixed to each object and followed; 0: none", low=0, high=1024)
    contacts: int = option(
        0, int, "rows", "of contacts, per object and 16 frames; 4 is a good number, 0: none", low=0, high=1000
    )
    energy: bool = option(False, bool, "", "books of energy and momentum, and what they leave unexplained")


@dataclasses.dataclass(frozen=True)
class MatchedOptions:
    """Sets of videos that share a scene and differ in one thing (matched.py); without `change` there are none."""

    change: tuple[str, ...] | None = option(
        None,
        str,
        "",
        f"what members differ in: a factor of the scene's, or {', '.join(matched.ACTS)}; one of a list for each set",
        several=True,
        optional=True,
    )
    members: int = option(2, int, "videos", "in a set, the original included", low=2, high=256)
    scale: Distribution | None = option(
        None, float, "1", "that a factor is multiplied by; null: it is drawn anew", above=0, draw=True, optional=True
    )
    objects: str = option(
        "one", str, "", "whose factor is changed where each has its own: one's or all's", choices=("one", "all")
    )
    onset: Distribution = option(
        [0.3, 0.7], float, "1", "share of a video before a violation", low=0, high=1, draw=True
    )
    distance: Distribution = option([2, 4], float, "m", "that teleport moves an object by", above=0, draw=True)
    gain: Distribution = option([1.5, 2.5], float, "1", "of an object's speed in energy_gain", low=0, draw=True)


@dataclasses.dataclass(frozen=True)
class StorageOptions:
    """How videos lie on disk."""

    format: str = option("hdf5", str, "", "file format of a shard", choices=("hdf5",))
    frames: str = option(
        "video",
        str,
        "",
        "video: stored; none: left out, to be drawn again with gen2d.render",
        choices=("video", "none"),
    )
    codec: str = option(
        "gzip", str, "", "of the frames: gzip opens everywhere, zstd is smaller, none can be mapped", choices=CODECS
    )
    chunk_frames: int | None = option(
        None,
        int,
        "frames",
        "compressed together; null: a whole video. Fewer make short windows faster to read and files larger",
        low=1,
        optional=True,
    )
    videos_per_shard: int | None = option(
        None,
        int,
        "videos",
        "null: the largest power of two with raw frames of 1 GiB at most, up to 1024",
        low=1,
        high=65536,
        optional=True,
    )
    lanes: int | None = option(
        None,
        int,
        "videos",
        "simulated at once by a device; null: 512, or fewer with many objects. Changes the last bits of a simulation",
        low=1,
        high=65536,
        optional=True,
    )


@dataclasses.dataclass(frozen=True)
class Plugin:
    """A named plug-in and its options."""

    name: str
    module: ModuleType
    options: Any
    sha256: str | None = None  # of a file of the user's own, which may change

    def plain(self) -> dict[str, Any]:
        """The plug-in as YAML and JSON hold it."""
        own = {"sha256": self.sha256} if self.sha256 else {}
        return {"name": self.name, **own, **_plain(self.options)}


@dataclasses.dataclass(frozen=True)
class Config:
    """Everything that decides what a dataset holds, but for its number of videos."""

    name: str
    seed: int
    video: VideoOptions
    scene: Plugin
    physics: PhysicsOptions
    camera: CameraOptions
    image: ImageOptions
    look: Plugin
    annotations: AnnotationOptions
    matched: MatchedOptions
    storage: StorageOptions

    def plain(self) -> dict[str, Any]:
        """The config as YAML and JSON hold it, every default filled in."""
        sections = {s: _plain(getattr(self, s)) for s in SECTIONS}
        plugs = {p: getattr(self, p).plain() for p in PLUGINS}
        return {"name": self.name, "seed": self.seed, **sections, **plugs}

    def text(self) -> str:
        """The resolved config as YAML; read again it gives the same config."""
        return yaml.safe_dump(self.plain(), sort_keys=False)

    def recipe(self) -> dict[str, Any]:
        """The config without its seed, which a dataset keeps and compares by itself."""
        return {key: value for key, value in self.plain().items() if key != "seed"}

    def sha256(self) -> str:
        """A hash of the recipe."""
        return hashlib.sha256(json.dumps(self.recipe(), sort_keys=True).encode()).hexdigest()


SECTIONS = {
    "video": VideoOptions,
    "physics": PhysicsOptions,
    "camera": CameraOptions,
    "image": ImageOptions,
    "annotations": AnnotationOptions,
    "matched": MatchedOptions,
    "storage": StorageOptions,
}
PLUGINS = {"scene": "bouncing", "look": "flat"}


def _plain(options: Any) -> dict[str, Any]:
    def value(v: Any) -> Any:
        if isinstance(v, tuple):
            return [value(x) for x in v]
        return v.plain() if isinstance(v, Distribution) else v

    return {f.name: value(getattr(options, f.name)) for f in dataclasses.fields(options)}


# Reading ------------------------------------------------------------------------------------------------------------


class _Loader(yaml.SafeLoader):
    """YAML with 1e-3 as a number (YAML 1.1 takes it for text) and without silently doubled keys."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?(\d[\d_]*)(\.[\d_]*)?[eE][-+]?\d+$"), list("-+0123456789")
)


def _mapping(loader: _Loader, node: yaml.MappingNode) -> dict:
    seen = set()
    for key, _ in node.value:
        if not isinstance(key.value, str):
            raise yaml.constructor.ConstructorError(None, None, "a name must be text", key.start_mark)
        if key.value in seen:
            raise yaml.constructor.ConstructorError(None, None, f"{key.value} stands there twice", key.start_mark)
        seen.add(key.value)
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:map", _mapping)


def parse_yaml(text: str, source: str) -> Any:
    """The value that a YAML text stands for."""
    try:
        return yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" in line {mark.line + 1}" if mark else ""
        raise ConfigError(f"{source}: not valid YAML{where}: {getattr(error, 'problem', None) or error}") from None
    except ValueError as error:  # a date that does not exist
        raise ConfigError(f"{source}: not valid YAML: {error}") from None


def _check(spec: Option, low: float, high: float) -> bool:
    return (
        (spec.low is None or low >= spec.low)
        and (spec.above is None or low > spec.above)
        and (spec.high is None or high <= spec.high)
    )


def _single(spec: Option, value: Any) -> Any:
    """A checked value, or ValueError with what is allowed."""
    if spec.draw:
        distribution = parse(value, spec.kind is int)
        if not _check(spec, *distribution.support):
            raise ValueError(spec.allowed + (" for every value drawn" if distribution.kind != "constant" else ""))
        return distribution
    if spec.kind is str:
        if not isinstance(value, str) or (spec.choices and value not in spec.choices):
            raise ValueError(spec.allowed)
        return value
    if spec.kind is bool and isinstance(value, bool):
        return value
    if not is_number(value) or spec.kind is bool:
        raise ValueError(spec.allowed)
    if (spec.kind is int and not float(value).is_integer()) or not _check(spec, value, value):
        raise ValueError(spec.allowed)
    return spec.kind(value)


def _value(spec: Option, value: Any) -> Any:
    if value is None and spec.optional:
        return None
    if spec.several:
        values = value if isinstance(value, list | tuple) and value else [value]
        return tuple(_single(spec, single) for single in values)
    if not spec.parts:
        return _single(spec, value)
    if not isinstance(value, list | tuple) or len(value) != spec.parts:
        raise ValueError(spec.allowed)
    return tuple(_single(spec, part) for part in value)


def build(cls: type, values: Any, where: str, source: str) -> Any:
    """An options dataclass from a mapping; `where` is the path of the mapping in the config."""
    if not isinstance(values, Mapping):
        raise ConfigError(f"{source}: {where} is {values!r}, but must be a mapping of options")
    known = {f.name: f.metadata["option"] for f in dataclasses.fields(cls)}
    filled = {}
    for key, value in values.items():
        if key not in known:
            raise ConfigError(f"{source}: {where}.{key} is not an option; {plugins.nearest(key, list(known))}")
        try:
            filled[key] = _value(known[key], value)
        except ValueError as error:
            raise ConfigError(f"{source}: {where}.{key} is {value!r}, but must be {error}") from None
    return cls(**filled)


def _plugin(kind: str, values: Any, default: str, source: str) -> Plugin:
    """A plug-in with its options; its bare name is enough."""
    values = {"name": values} if isinstance(values, str) else {} if values is None else values
    if not isinstance(values, Mapping):
        raise ConfigError(f"{source}: {kind} is {values!r}, but must be a name, or a mapping with a name and options")
    name = values.get("name", default)
    if not isinstance(name, str):
        raise ConfigError(f"{source}: {kind}.name is {name!r}, but must be one of {', '.join(plugins.names(kind))}")
    module = plugins.load(kind, name, source)
    sha256 = plugins.sha256(name)
    if values.get("sha256", sha256) != sha256:
        raise ConfigError(f"{source}: {kind}.sha256 is of another version of {name}")
    options = build(module.Options, {k: v for k, v in values.items() if k not in ("name", "sha256")}, kind, source)
    if hasattr(module, "check"):
        try:
            module.check(options)
        except ValueError as error:
            raise ConfigError(f"{source}: {kind}.{error}") from None
    return Plugin(name, module, options, sha256)


def _overridden(values: dict, sets: Sequence[str]) -> dict:
    """The mapping with each `a.b=value` put in its place."""
    for text in sets:
        path, equals, value = text.partition("=")
        keys = path.strip().split(".")
        if not equals or not all(keys):
            raise ConfigError(f"--set is {text!r}, but must be section.option=value, such as physics.substeps=8")
        place = values
        for key in keys[:-1]:
            inner = place.get(key)
            if not isinstance(inner, str | Mapping | None):
                raise ConfigError(f"--set is {text!r}, but {key} is {inner!r}, which has no options of its own")
            place[key] = {"name": inner} if isinstance(inner, str) else dict(inner or {})
            place = place[key]
        place[keys[-1]] = parse_yaml(value, f"--set {path}")
    return values


def checked_seed(value: Any, what: str = "--seed") -> int:
    """The seed, if it is one; `what` names it in the error."""
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= MAX_SEED:
        raise ConfigError(f"{what} is {value!r}, but must be a whole number from 0 to 2**63 - 1")
    return value


def from_mapping(values: Any, source: str, name: str = "dataset") -> Config:
    """The config that a mapping stands for; every error names `source`."""
    if not isinstance(values, Mapping):
        raise ConfigError(f"{source}: holds {type(values).__name__}, but must hold a mapping of sections")
    known = ["name", "seed", *SECTIONS, *PLUGINS]
    for key in values:
        if key not in known:
            raise ConfigError(f"{source}: {key} is not a section; {plugins.nearest(key, known)}")
    name = values.get("name", name)
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}", name):
        raise ConfigError(f"{source}: name is {name!r}, but must be letters, digits, '.', '_' and '-', 100 at most")
    seed = checked_seed(values.get("seed", 0), f"{source}: seed")
    sections: dict[str, Any] = {
        s: build(cls, {} if values.get(s) is None else values[s], s, source) for s, cls in SECTIONS.items()
    }
    plugs: dict[str, Any] = {p: _plugin(p, values.get(p), default, source) for p, default in PLUGINS.items()}
    frames, chunk = sections["video"].frames, sections["storage"].chunk_frames
    if chunk is not None and frames % chunk:
        raise ConfigError(f"{source}: storage.chunk_frames is {chunk}, but must divide video.frames, which is {frames}")
    sets = (plugs["scene"], sections["video"], sections["annotations"], sections["camera"])
    try:
        matched.check(sections["matched"], MatchedOptions(), *sets)
    except ValueError as error:
        raise ConfigError(f"{source}: matched.{error}") from None
    return Config(name=name, seed=seed, **sections, **plugs)


def load_config(config: "Config | Mapping | str | pathlib.Path", sets: Sequence[str] = ()) -> Config:
    """A Config from a file's name or path, from a mapping, or from a Config; `sets` overrides: 'physics.substeps=8'."""
    if isinstance(config, Config):
        return from_mapping(_overridden(config.plain(), sets), "config") if sets else config
    if isinstance(config, Mapping):
        return from_mapping(_overridden(dict(config), sets), "config")
    path = plugins.find_config(str(config))
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read as text ({error})") from None
    values = parse_yaml(text, str(path))
    if values is not None and not isinstance(values, Mapping):
        raise ConfigError(f"{path}: holds {type(values).__name__}, but must hold a mapping of sections")
    stem = re.sub(r"[^A-Za-z0-9._-]+", "-", path.stem).lstrip("._-")[:100] or "dataset"
    return from_mapping(_overridden(dict(values or {}), sets), str(path), stem)
