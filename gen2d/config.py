"""What a dataset is made from: every option with its unit, default and range, read from YAML and checked once, here.

An error is one sentence with the file, the field, its value and what is allowed.
"""

import dataclasses
import hashlib
import json
import pathlib
import re
from collections.abc import Mapping, Sequence
from typing import Any

import yaml

from gen2d import matched, plugins, quality
from gen2d.core.errors import ConfigError
from gen2d.distributions import Distribution
from gen2d.laws import Law
from gen2d.options import (
    NO_COPIES,
    Copies,
    Plugin,
    StoredCopies,
    build,
    coordinates,
    named,
    option,
    plain_of,
    plugin_of,
)
from gen2d.splits import CHANGES, Split, laws_of, with_splits
from gen2d.storage.codecs import CODECS
from gen2d.storage.explain import reason
from gen2d.storage.sealed import read_bytes

MAX_SEED = 2**63 - 1
MAX_SLOTS = 254  # a slot's mask id is one byte, 0 is the background


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
    words: bool = option(False, bool, "", "a caption and a list of events, as text; they need contacts")
    predictability: bool = option(False, bool, "", "how fast a small change of the start grows")


@dataclasses.dataclass(frozen=True)
class QualityOptions:
    """Which videos are kept: those within these ranges, others are made instead (null: any)."""

    contacts_least: int | None = option(None, int, "contacts", "that begin in a video", low=0, optional=True)
    contacts_most: int | None = option(None, int, "contacts", "that begin in a video", low=0, optional=True)
    penetration_least: float | None = option(None, float, "m", "of a video's deepest overlap", low=0, optional=True)
    penetration_most: float | None = option(None, float, "m", "of a video's deepest overlap", low=0, optional=True)
    growth_least: float | None = option(
        None, float, "1/s", "of a small change; needs annotations.predictability", optional=True
    )
    growth_most: float | None = option(
        None, float, "1/s", "of a small change; needs annotations.predictability", optional=True
    )
    residual_least: float | None = option(None, float, "J", "of energy; needs annotations.energy", low=0, optional=True)
    residual_most: float | None = option(None, float, "J", "of energy; needs annotations.energy", low=0, optional=True)
    visibility_least: float | None = option(
        None, float, "1", "of the object least seen; needs annotations.visibility", low=0, high=1, optional=True
    )
    visibility_most: float | None = option(
        None, float, "1", "of the object least seen; needs annotations.visibility", low=0, high=1, optional=True
    )
    attempts: int = option(1000, int, "attempts", "at a video, at most", low=1, high=1_000_000)


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
    quality: QualityOptions
    storage: StorageOptions
    splits: tuple[Split, ...] = ()

    def plain(self) -> dict[str, Any]:
        """The config as YAML and JSON hold it, every default filled in."""
        sections = {s: plain_of(getattr(self, s)) for s in SECTIONS}
        plugs = {p: getattr(self, p).plain() for p in PLUGINS}
        splits = {"splits": {split.name: split.plain() for split in self.splits}} if self.splits else {}
        return {"name": self.name, "seed": self.seed, **sections, **plugs, **splits}

    def text(self) -> str:
        """The resolved config as YAML; read again it gives the same config."""
        return yaml.safe_dump(self.plain(), sort_keys=False)

    def recipe_text(self) -> str:
        """The recipe with its seed as YAML: what a dataset keeps, however many videos it has."""
        return yaml.safe_dump({"name": self.name, "seed": self.seed, **self.recipe()}, sort_keys=False)

    @property
    def copies(self) -> Copies:
        """What the files of the user's own hold, by their names in the config."""
        looks = [split.own["look"] for split in self.splits if "look" in split.own]
        return {plugin.name: plugin.content for plugin in (self.scene, self.look, *looks) if plugin.sha256}

    def recipe(self) -> dict[str, Any]:
        """The config without its seed, which a dataset keeps and compares by itself, and without numbers of videos."""
        plain = {key: value for key, value in self.plain().items() if key != "seed"}
        for split in plain.get("splits", {}).values():
            split.pop("videos", None)
        return plain

    @property
    def training(self) -> Split | None:
        """The split that the others are compared with: `train`, or else the first; None where there are none."""
        return next((split for split in self.splits if split.name == "train"), next(iter(self.splits), None))

    def row(self, split: str) -> int:
        """The place of a split's law among the config's; any split has the only one where the config has none."""
        names = [own.name for own in self.splits]
        if names and split not in names:
            raise ConfigError(f"--split is {split!r}, but must be one of the config's: {', '.join(names)}")
        return names.index(split) if names else 0

    @property
    def laws(self) -> list[Law]:
        """The laws of the splits in order, or that of the scene alone."""
        return laws_of(self.scene, self.splits)

    def frames_of(self, split: str) -> int:
        """How many frames of a split's videos its reader gets, the first ones."""
        own = self.splits[self.row(split)].frames if self.splits else None
        return own or self.video.frames

    def of_split(self, name: str) -> "Config":
        """The config as it is for a split, with the look or the physics that this one has of its own."""
        return dataclasses.replace(self, **self.splits[self.row(name)].own) if self.splits else self

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
    "quality": QualityOptions,
    "storage": StorageOptions,
}
PLUGINS = {"scene": "bouncing", "look": "flat"}


def _merged(own: Mapping[str, Any], other: Any) -> Any:
    """A section with other options; another plug-in has its defaults."""
    other = named(other)
    if not isinstance(other, Mapping):
        return other  # reading it says what is wrong
    return dict(other) if other.get("name", own.get("name")) != own.get("name") else {**own, **other}


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


YAML_BYTES = 2**20  # of a config
YAML_DEPTH, YAML_NODES = 40, 50_000  # of what it stands for, each alias as often as it stands there


def _check_bounds(text: str) -> None:
    """Raises ConfigError for a YAML text that stands for more than a config could be, before it is read."""
    sizes: dict[str, int] = {}  # of what has an anchor
    open_nodes: list[tuple[str | None, int]] = []  # anchor, and how many nodes there were before
    nodes = 0
    for event in yaml.parse(text, _Loader):
        if isinstance(event, yaml.AliasEvent):
            nodes += sizes.get(event.anchor, 1)  # one that is not known, or open still, is an error later
        elif isinstance(event, yaml.ScalarEvent):
            nodes += 1
            sizes |= {event.anchor: 1} if event.anchor else {}
        elif isinstance(event, yaml.CollectionStartEvent):
            open_nodes.append((event.anchor, nodes))
            nodes += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = open_nodes.pop()
            sizes |= {anchor: nodes - before} if anchor else {}
        if len(open_nodes) > YAML_DEPTH:
            raise yaml.YAMLError(f"nested more than {YAML_DEPTH} deep")
        if nodes > YAML_NODES:
            raise yaml.YAMLError(f"more than {YAML_NODES:,} values")


def parse_yaml(text: str, source: str) -> Any:
    """The value that a YAML text stands for."""
    try:
        _check_bounds(text)
        return yaml.load(text, _Loader)
    except RecursionError:
        raise ConfigError(f"{source}: not valid YAML: it holds itself") from None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" in line {mark.line + 1}" if mark else ""
        raise ConfigError(f"{source}: not valid YAML{where}: {getattr(error, 'problem', None) or error}") from None
    except ValueError as error:  # a date that does not exist
        raise ConfigError(f"{source}: not valid YAML: {error}") from None


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
            place[key] = dict(named(inner) or {})
            place = place[key]
        place[keys[-1]] = parse_yaml(value, f"--set {path}")
    return values


def checked_seed(value: Any, what: str = "--seed") -> int:
    """The seed, if it is one; `what` names it in the error."""
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= MAX_SEED:
        raise ConfigError(f"{what} is {value!r}, but must be a whole number from 0 to 2**63 - 1")
    return value


def _section(name: str, values: Any, source: str, copies: Copies) -> Any:
    """The options of a section, or a plug-in."""
    if name in PLUGINS:
        return plugin_of(name, values, PLUGINS[name], source, copies)
    return build(SECTIONS[name], {} if values is None else values, name, source)


def from_mapping(values: Any, source: str, name: str = "dataset", copies: Copies = NO_COPIES) -> Config:
    """The config that a mapping stands for; every error names `source`."""
    if not isinstance(values, Mapping):
        raise ConfigError(f"{source}: holds {type(values).__name__}, but must hold a mapping of sections")
    known = ["name", "seed", *SECTIONS, *PLUGINS, "splits"]
    for key in values:
        if key not in known:
            raise ConfigError(f"{source}: {key} is not a section; {plugins.nearest(key, known)}")
    name = values.get("name", name)
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}", name):
        raise ConfigError(f"{source}: name is {name!r}, but must be letters, digits, '.', '_' and '-', 100 at most")
    seed = checked_seed(values.get("seed", 0), f"{source}: seed")
    sections: dict[str, Any] = {s: _section(s, values.get(s), source, copies) for s in (*SECTIONS, *PLUGINS)}
    frames, chunk = sections["video"].frames, sections["storage"].chunk_frames
    if chunk is not None and frames % chunk:
        raise ConfigError(f"{source}: storage.chunk_frames is {chunk}, but must divide video.frames, which is {frames}")
    if sections["annotations"].words and not sections["annotations"].contacts:
        raise ConfigError(f"{source}: annotations.contacts is 0, but annotations.words needs them: 4 is a good number")
    config = Config(name=name, seed=seed, **sections)
    _check_grids(config, source)
    enabled = {f"annotations.{name}": bool(value) for name, value in vars(config.annotations).items()}
    try:
        quality.check(config.quality, enabled)
    except ValueError as error:
        raise ConfigError(f"{source}: quality.{error}") from None
    if values.get("splits"):
        config = _with_splits(config, values["splits"], source, copies)
    _check_sets(config, source)
    return config


def _with_splits(config: Config, written: Any, source: str, copies: Copies) -> Config:
    scene, splits = with_splits(config.scene, written, source)
    together = {**copies, **config.copies}
    copies = StoredCopies(together) if isinstance(copies, StoredCopies) else together
    plain, made = config.plain(), []
    for split in splits:
        if (split.frames or 0) > config.video.frames:
            told = f"{source}: splits.{split.name}.frames is {split.frames}, but must be video.frames"
            raise ConfigError(f"{told}, {config.video.frames}, or less")
        changes, own = split.plain(), {}
        try:
            for name in (name for name in CHANGES if name in changes):
                own[name] = _section(name, _merged(plain[name], changes[name]), "config", copies)
        except ConfigError as error:
            raise ConfigError(f"{source}: splits.{split.name}: {str(error).removeprefix('config: ')}") from None
        if "look" in own and own["look"].sha256:
            changes["look"] = named(changes["look"]) | {"sha256": own["look"].sha256}
        made.append(dataclasses.replace(split, written=json.dumps(changes), own=own))
    return dataclasses.replace(config, scene=scene, splits=tuple(made))


def own_files(plain: Mapping[str, Any]) -> dict[str, str]:
    """The names of the user's own files in a config (`Config.plain`), by where a dataset keeps their copies."""
    splits = plain.get("splits")
    written = {f"splits/{name}/look": split for name, split in (splits or {}).items()} if _is_mapping(splits) else {}
    looks = {place: split["look"] for place, split in written.items() if _is_mapping(split) and "look" in split}
    places = {kind: plain[kind] for kind in PLUGINS if kind in plain} | looks
    names = {kind: named(look).get("name", "") for kind, look in places.items() if _is_mapping(named(look))}
    own = {kind: name for kind, name in names.items() if isinstance(name, str) and plugins.is_own(name)}
    return {plugins.copy_name(kind, name): name for kind, name in own.items()}


def _is_mapping(value: Any) -> bool:
    return isinstance(value, Mapping)


def _check_sets(config: Config, source: str) -> None:
    """Raises ConfigError for matched sets that cannot be made."""
    about = config.scene, config.video, config.annotations, config.camera
    try:
        matched.check(config.matched, MatchedOptions(), *about)
        if config.matched.change and quality.ranges(config.quality):
            raise ValueError("change is given, but a set has one scene: quality must ask for nothing")
        if config.matched.change and any(law.combinations()[0] for law in config.laws):
            raise ValueError("change is given, but its scenes cannot be on a grid")
    except ValueError as error:
        raise ConfigError(f"{source}: matched.{error}") from None


def _check_grids(config: Config, source: str) -> None:
    """Raises ConfigError for a grid that is not of a scene's factor, one number a video."""
    sections = {name: getattr(config, name) for name in SECTIONS} | {p: getattr(config, p).options for p in PLUGINS}
    for section, options in sections.items():
        for field in dataclasses.fields(options):
            spec, value = field.metadata["option"], getattr(options, field.name)
            parts = coordinates(field.name, value).values() if spec.draw and value is not None else ()
            gridded = any(simple.kind == "grid" for part in parts for _, simple in part.weighted)
            if gridded and (section != "scene" or spec.each):
                raise ConfigError(
                    f"{source}: {section}.{field.name} is on a grid, but only a scene's numbers of a whole video can be"
                )


def load_config(
    config: "Config | Mapping | str | pathlib.Path", sets: Sequence[str] = (), copies: Copies = NO_COPIES
) -> Config:
    """A Config from a file's name or path, from a mapping, or from a Config; `sets` overrides: 'physics.substeps=8'.

    `copies` are of families and looks of the user's own, by their names, for where these are gone or have changed.
    """
    if isinstance(config, Config):
        return load_config(config.plain(), sets, config.copies) if sets else config
    if isinstance(config, Mapping):
        return from_mapping(_overridden(dict(config), sets), "config", copies=copies)
    path = plugins.find_config(str(config))
    try:
        text = read_bytes(path, YAML_BYTES).decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read as text ({reason(error)})") from None
    values = parse_yaml(text, str(path))
    if values is not None and not isinstance(values, Mapping):
        raise ConfigError(f"{path}: holds {type(values).__name__}, but must hold a mapping of sections")
    stem = re.sub(r"[^A-Za-z0-9._-]+", "-", path.stem).lstrip("._-")[:100] or "dataset"
    return from_mapping(_overridden(dict(values or {}), sets), str(path), stem)
